"""Numbers in sentences."""


def counted(number: int, noun: str) -> str:
    """A number with its noun, in the plural unless it is one.

    >>> counted(1, "boundary loop"), counted(0, "component")
    ('1 boundary loop', '0 components')
    """
    return f"{number} {noun}{'' if number == 1 else 's'}"
