"""Lists that parametrise the generic tests: whoever adds a variant adds one line here."""

ALL_RENDERERS = ("reference", "cpu", "gsplat")
ALL_METHODS = ("3dgs", "auto", "energy_balance", "etgs", "ntr_gaussian", "ravigs", "supirgs", "thermogs", "ti3dgs")
