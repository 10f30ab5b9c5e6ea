"""Errors for people: what was found, what was expected, what to do next."""


class UserError(Exception):
    """A problem the user can mend. The command line prints it as one message and exits with status 2.

    Args:
        found: what came, with names and numbers.
        expected: what the program needed instead.
        remedy: what to do next.
    """

    def __init__(self, found: str, expected: str, remedy: str):
        self.found, self.expected, self.remedy = found, expected, remedy
        super().__init__(f"{found}\n  expected: {expected}\n  what to do: {remedy}")

    def __reduce__(self) -> tuple[type["UserError"], tuple[str, str, str]]:
        """Processes hand it on."""
        return type(self), (self.found, self.expected, self.remedy)
