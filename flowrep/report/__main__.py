"""`python -m flowrep.report outputs/<sweep>`."""

from flowrep.console import report

if __name__ == "__main__":
    report()
