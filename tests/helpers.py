"""Lists that parametrise the generic tests: whoever adds a variant adds one line here."""

ALL_RENDERERS = ("reference", "cpu", "gsplat")
ALL_METHODS = ("3dgs", "etgs", "ravigs", "supirgs", "ti3dgs")
