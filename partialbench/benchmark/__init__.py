"""Protocol, training, evaluation, metrics and result records."""
