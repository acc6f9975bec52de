"""The paper's tables, whole: every method at equal training, or from weights that there are."""
