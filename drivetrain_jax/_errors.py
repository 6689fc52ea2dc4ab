"""Errors that a caller can act on."""


class InputError(ValueError):
    """The user's input is wrong; the message is one line: the field, what was given, what is allowed."""


class ChunkError(RuntimeError):
    """Something could not be computed; the message names the chunk and the reason."""


class Passing(ChunkError):
    """The reason may be gone the next time: memory or a disk that is full, a worker or a scheduler that has died."""
