"""The error that a mock swarm raises when it is wrong itself."""


class InvariantError(AssertionError):
    """The swarm broke a promise: our bug, never the user's."""
