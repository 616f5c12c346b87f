"""Hard cases of arithmetic, one family per file; ``heatsplat.studies.stability`` runs them."""
