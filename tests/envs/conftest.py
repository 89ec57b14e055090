import pytest


@pytest.fixture(autouse=True)
def share_streets(open_streets):
    """All tests of envs make streets."""
