"""`python -m flowrep.report outputs/<sweep>`."""

from flowrep.report.command import main

if __name__ == "__main__":
    main()
