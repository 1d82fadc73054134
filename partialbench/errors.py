"""The errors a user meets: each says what was wrong, the value, what was expected, what to do."""


class PartialbenchError(Exception):
    """Base of every error this project raises for a reason a user can act on."""


class InputError(PartialbenchError, ValueError):
    """An input file, folder or argument is not what it should be."""


class ConfigurationMismatchError(PartialbenchError):
    """An output folder was made with another configuration than the one asked for."""
