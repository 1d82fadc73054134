"""From weights to predictions and what they are worth."""
