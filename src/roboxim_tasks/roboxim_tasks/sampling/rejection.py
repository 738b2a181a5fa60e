"""The error of a rejected draw, shared by the components and the placement module."""


class RejectedError(Exception):
    """A drawn scene violates a constraint; the resetter draws the placement again."""

    def __init__(self, constraint: str, cause: str = "") -> None:
        """Store the name of the violated constraint, and its cause with a number if it is known."""
        super().__init__(constraint)
        self.constraint = constraint
        self.cause = cause
