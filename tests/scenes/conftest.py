from pathlib import Path

import pytest
import yaml


@pytest.fixture
def data():
    """A fork of roads, people along one and across another, a parked car."""
    return yaml.safe_load((Path(__file__).parent / "crossroads.yaml").read_text())
