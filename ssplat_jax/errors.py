"""What can go wrong outside jit. The command line turns each into one line and an exit code."""


class InputError(ValueError):
    """Input from outside is unusable: a capture, an image, a camera, an option. Exit code 2.

    The message says which file (and field), what was wanted, what came, and what to do.
    """


def require_positive(**numbers: int | float) -> None:
    """Refuses options below what counts one thing.

    Raises:
        InputError: naming the first number that is not positive.
    """
    for name, value in numbers.items():
        if not value > 0:
            raise InputError(f"--{name.replace('_', '-')}: wanted a number above 0, got {value}.")


class StorageError(OSError):
    """Reading or writing saved state failed: a full disk, a corrupt checkpoint. Exit code 3."""


class CacheError(RuntimeError):
    """The cache could not hold what it was given; raised by `cache.check`, outside jit, with the remedy."""
