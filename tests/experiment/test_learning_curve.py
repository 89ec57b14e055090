from matplotlib.axes import Axes

from flowrep.experiment.learning_curve import draw_learning_curve


def test_the_curve_shows_the_runs_own_greedy_evaluations_at_its_own_speed(tmp_path, monkeypatch):
    drawn = []
    monkeypatch.setattr(Axes, "errorbar", lambda self, x, y, *_, **__: drawn.append((x, y)))
    row = {"evaluation": "training", "policy": "greedy", "speed": "normal", "fps": "12.0"}
    row |= {"frames": "100", "outcome": "success"}
    others = {"evaluation": "evaluate", "policy": "sampled", "speed": "low", "fps": "6.0"}
    rows = [row, row | {"outcome": "timeout"}, row | {"evaluation": "final", "frames": "200"}]
    rows += [row | {key: value} for key, value in others.items()]
    rows.append(row | {"frames": "200", "outcome": "timeout"})  # other episodes than the final ones
    metrics = [{"frames": "50", "success": "0.5"}, {"frames": "100", "success": "nan"}]
    for points, episodes in ((metrics, rows), ([], [])):
        draw_learning_curve(tmp_path / "a.png", points, episodes, speed="normal", fps=12.0)
    assert drawn == [(100, 0.5), (200, 1.0)]
    assert [file.name for file in tmp_path.iterdir()] == ["a.png"]
