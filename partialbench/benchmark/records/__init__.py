"""What was run, as it is written down and read again."""
