"""The classifiers of the paper's main table, one file per model."""
