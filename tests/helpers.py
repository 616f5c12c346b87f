"""Lists that parametrise the generic tests: whoever adds a variant adds one line here."""

ALL_RENDERERS = ("reference", "cpu", "gsplat")
