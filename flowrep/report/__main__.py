"""`python -m flowrep.report outputs/<sweep>`."""

import sys

try:
    from flowrep.report.command import main
except ImportError as error:
    sys.exit(f"error: {error}")

if __name__ == "__main__":
    main()
