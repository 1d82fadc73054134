"""The board as tables: what each is of, and how it is written."""
