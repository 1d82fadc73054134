"""Every run of a board as one file says them: what is done, what is missing, doing it."""
