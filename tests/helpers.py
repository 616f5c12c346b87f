"""Lists that parametrise the generic tests: whoever adds a variant adds one line here."""

ALL_RENDERERS = ("reference", "cpu", "gsplat")
ALL_METHODS = (
    "3dgs", "3dgs_ir", "auto", "energy_balance", "etgs", "hexplane_4dgs", "mftg", "mip_splatting", "msmg", "ntr_gaussian",
    "ommg", "ravigs", "supirgs", "thermal3dgs", "thermalgs", "thermogs", "ti3dgs",
)  # fmt: skip
