"""Hard cases of arithmetic, one family per file; ``study.py`` runs them."""
