"""The one exception for mistakes that a user can mend."""


class UserError(Exception):
    """A mistake in the input, told in one sentence: which file, what is wrong, what to do.

    The commands print it on stderr and leave with exit code 2; library users catch it like any
    exception. Programming errors are not of this type and keep their traceback.
    """
