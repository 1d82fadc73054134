"""The board's figures as files, made on request."""
