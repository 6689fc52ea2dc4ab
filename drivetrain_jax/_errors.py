"""Errors that a caller can act on."""


class InputError(ValueError):
    """The user's input is wrong; the message is one line: the field, what was given, what is allowed."""
