"""What to say where the packages of an extra are missing."""

import sys
from importlib.util import find_spec


def require(what: str, extra: str, *packages: str, module: str = "") -> None:
    """Checks that packages are installed, before a module imports them.

    Args:
        what: needs them, e.g. "training".
        extra: of flowrep's, that has them.
        packages: by the names that they are imported by.
        module: `__name__` of the module; one that is run as a command ends in one line.

    Raises:
        ImportError: naming the first that is missing, and the extra.
    """
    for package in packages:
        if find_spec(package) is None:
            message = f"{what} needs {package}; run: pip install 'flowrep[{extra}]'"
            if module == "__main__":
                sys.exit(f"error: {message}")
            raise ImportError(message)
