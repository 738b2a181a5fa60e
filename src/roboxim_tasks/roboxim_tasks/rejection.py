"""The error of a draw that is drawn again: here, as components and what places their objects both raise it."""


class RejectedError(Exception):
    """A drawn scene breaks a constraint; the resetter draws the placement again."""

    def __init__(self, constraint: str) -> None:
        """Remember the constraint's name."""
        super().__init__(constraint)
        self.constraint = constraint
