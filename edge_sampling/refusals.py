"""What is refused, by type: programs tell it from defects by these, and by nothing in the text."""


class InputError(ValueError):
    """Something that the user can mend. The text is one line that names it."""


class Refusal(RuntimeError):
    """Something that cannot be done with this scene, or on this machine. The text is one line that says why."""
