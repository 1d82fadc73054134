"""From the rules to trained weights."""
