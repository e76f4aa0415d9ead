"""Errors and notes about what a user gave. Each is one line that names the file or argument and what is wrong."""


class BadInput(Exception):
    """Input that cannot be used: the base of all errors of this module."""


class SceneError(BadInput, ValueError):
    """A scene, schedule or result file that cannot be used; the message names the file, the key and the cause."""


class StoreError(BadInput):
    """A store of checks that cannot be used."""


class DoubtfulInput(UserWarning):
    """Input that can be used, but may not be what was meant; the command line prints it as a note."""
