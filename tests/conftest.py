"""Scenes for the tests: Straight Road, and what is left of it without people.

Each imports what it needs: some tests run where no simulator is installed.
"""

import gc
import signal
import tempfile
from collections import Counter
from contextlib import ExitStack, closing
from dataclasses import replace
from pathlib import Path

import pytest

from flowrep.extras import is_installed


def pytest_configure():
    """Lets signals be heard that a shell in the background, or `nohup`, has ignored.

    And imports everything without the garbage collector, which would take a quarter of the time.
    """
    gc.disable()
    if signal.getsignal(signal.SIGINT) is signal.SIG_IGN:
        signal.signal(signal.SIGINT, signal.default_int_handler)
    if signal.getsignal(signal.SIGHUP) is signal.SIG_IGN:
        signal.signal(signal.SIGHUP, signal.SIG_DFL)


@pytest.hookimpl(tryfirst=True)
def pytest_collection_modifyitems(items):
    """Makes the cases after the first slow where a test says so, before `-m` looks.

    Files with many slow tests come first: what processes take over from one another is short.
    """
    seen = set()
    for item in items:
        if item.get_closest_marker("slow_after_first"):
            test = item.nodeid.partition("[")[0]
            if test in seen:
                item.add_marker("slow")
            seen.add(test)
    slow = Counter(item.path for item in items if item.get_closest_marker("slow"))
    items.sort(key=lambda item: -slow[item.path])


def pytest_collection_finish():
    """Has the garbage collector leave alone what is there for good: some 650,000 objects."""
    gc.collect()
    gc.freeze()
    gc.enable()


OPTIONAL = {
    "pybullet": "the simulated streets need PyBullet",  # Python 3.14 has no wheels of it
    "cv2": "recordings need OpenCV",
    "imageio": "videos need imageio",
    "rosbags": "pip install 'flowrep-rl[rosbag]'",
    "scipy": "pip install 'flowrep-rl[report]'",
    "jinja2": "pip install 'flowrep-rl[report]'",
}
MISSING = {name: why for name, why in OPTIONAL.items() if not is_installed(name)}


@pytest.hookimpl(wrapper=True)
def pytest_make_collect_report(collector):
    """Skips files that can't be imported without a package that is missing."""
    report = yield
    needed = [name for name in MISSING if report.failed and name in str(report.longrepr)]
    if needed:
        report.outcome = "skipped"
        report.longrepr = (str(collector.path), 0, f"Skipped: {MISSING[needed[0]]}")
    return report


@pytest.hookimpl(wrapper=True)
def pytest_runtest_makereport(item, call):
    """Skips tests that import a missing package as they run."""
    report = yield
    error = call.excinfo and call.excinfo.value
    if isinstance(error, ModuleNotFoundError) and error.name in MISSING:
        report.outcome = "skipped"
        report.longrepr = (str(item.path), 0, f"Skipped: {MISSING[error.name]}")
    return report


@pytest.fixture(scope="session")
def straight_road():
    from flowrep.scenes import load_scene

    return load_scene("straight_road")


@pytest.fixture(scope="session")
def empty_road(straight_road):
    """Nobody walks here; the vehicle starts at (0, 0) and looks along x."""
    return replace(straight_road, pedestrian_groups=())


@pytest.fixture(scope="session")
def one_stands(straight_road):
    """One person stands at (30, 0), in the vehicle's way."""
    from flowrep.scenes.scene import PedestrianGroup, Walk

    walk = Walk("points", points_m=((30.0, -0.01), (30.0, 0.01)))
    person = PedestrianGroup("one", 1, 0.0, walk, standing=1)
    return replace(straight_road, pedestrian_groups=(person,))


@pytest.fixture
def close_later():
    """Takes what has to be closed when the test ends, and returns it."""
    with ExitStack() as stack:
        yield lambda made: stack.enter_context(closing(made))


@pytest.fixture(scope="session")
def open_streets():
    """Streets of one scene share what takes longest to build, as long as one of them is open."""
    from flowrep.envs import StreetEnv

    streets = [StreetEnv(scene, sensors=()) for scene in ("straight_road", "h_shaped_pathways")]
    yield
    for street in streets:
        street.close()


@pytest.fixture
def make_street(close_later, open_streets):
    """Makes streets that are closed when the test ends."""
    from flowrep.envs import StreetEnv

    return lambda *args, **kwargs: close_later(StreetEnv(*args, **kwargs))


@pytest.fixture
def drive(open_streets):
    """Drives episodes 0, 1, ... with a baseline, and returns them as they end."""
    from flowrep.baselines import BaselinePolicy
    from flowrep.envs import make_env
    from flowrep.experiment.evaluation import evaluate

    def drive(baseline, count, scene="straight_road", **options):
        env = make_env(scene, num_envs=min(count, 20))
        episodes = [{"episode_seed": seed, **options} for seed in range(count)]
        found = list(evaluate(env, BaselinePolicy(baseline), episodes))
        env.close()
        return found

    return drive


@pytest.fixture
def short_folder():
    """A folder for what commands leave in TMPDIR: sockets want a short path."""
    with tempfile.TemporaryDirectory(prefix="fr") as folder:
        yield Path(folder)


@pytest.fixture
def victim(tmp_path):
    """A table of the user's, which links of a stranger point at; nothing changes it."""
    path = tmp_path / "elsewhere" / "victim"
    path.parent.mkdir()
    path.write_text("frames,alpha\n1,2\n")
    yield path
    assert path.read_text() == "frames,alpha\n1,2\n"
    assert [*path.parent.iterdir()] == [path]
