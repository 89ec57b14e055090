"""`python -m flowrep.report outputs/<sweep>`."""

import sys

from flowrep.console import prepare

if __name__ == "__main__":
    prepare()
try:
    from flowrep.report.command import main
except ImportError as error:
    sys.exit(f"error: {error}")

if __name__ == "__main__":
    main()
