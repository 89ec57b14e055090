"""The error for missing packages of an extra."""

import sys
from importlib.util import find_spec


def require(what: str, extra: str, *packages: str, module: str = "") -> None:
    """Checks that packages are installed, before a module imports them.

    Args:
        what: the feature that needs them, e.g. "training".
        extra: the extra of flowrep that installs them.
        packages: their import names.
        module: `__name__` of the module; if it runs as a command, the process ends in one line.

    Raises:
        ImportError: a package is missing; names the first one and the extra.
    """
    for package in packages:
        if find_spec(package) is None:
            message = f"{what} needs {package}; run: pip install 'flowrep[{extra}]'"
            if module == "__main__":
                sys.exit(f"error: {message}")
            raise ImportError(message)
