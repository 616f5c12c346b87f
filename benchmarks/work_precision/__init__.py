"""Problems of heat and ways to solve them, for the study of what accuracy costs."""
