"""Exceptions that a caller can handle."""


class InputError(ValueError):
    """Raised for wrong input; the message is one line with the field, the value and what is allowed."""


class ChunkError(RuntimeError):
    """Raised for a failed computation; the message names the chunk and the reason."""


class RetryableError(ChunkError):
    """Raised for a cause that may vanish: too little memory, a full disk, a dead worker or scheduler."""
