"""`python -m flowrep.factorize` from a folder to flow files, pictures, a video and a table."""

from __future__ import annotations

import inspect
import json
import re
import shutil
import signal
from functools import partial
from pathlib import Path

import cv2
import imageio.v3 as imageio
import numpy as np
import pytest
from hydra.utils import get_class
from omegaconf import OmegaConf

from flowrep.config import CONF_DIR, group_choices
from flowrep.config.usage import UsageError
from flowrep.factorize import factorize_recording, open_stream
from flowrep.files import read_rows
from flowrep.sequences import Frame, SequenceError, open_recording, read_flow, recorded_motion
from flowrep.sequences.formats import declaration
from flowrep.sequences.job import Job
from flowrep.sequences.output import Output
from tests.config.composing import config_of
from tests.running import run_here
from tests.sequences import synthetic
from tests.sequences.synthetic import SEVEN_SCENES, needs_7scenes
from tests.test_files import fails

settings = partial(config_of, "factorize")


def factorize(tmp_path, *overrides, source="in", format="frames"):
    out = tmp_path / "out"
    given = [f"input={tmp_path / source}", f"format={format}", f"output={out}"]
    return factorize_recording(settings(*given, *overrides)), out


def table(folder):
    return read_rows(folder / "frames.csv")


@pytest.fixture
def moments(tmp_path):
    return synthetic.write_frames(tmp_path / "in")


def test_a_full_disk_is_named(moments, tmp_path, monkeypatch):
    monkeypatch.setattr("flowrep.sequences.output.write_flo", fails)
    with pytest.raises(OSError, match=r"free some space.*out\.partial"):
        factorize(tmp_path)


def test_a_job_writes_flow_pictures_masks_tables_and_a_video(moments, tmp_path):
    everything = ["flow_files=[flo,kitti,npz]", "pictures_every=2", "moving_px=0.01"]
    code, out = factorize(tmp_path, "flow=exact", *everything)
    assert code == 0
    kinds = ("raw", "ego", "obj")
    flows = [f"flow/{k}/{n}{s}" for k in kinds for n in ("0001", "0002") for s in (".flo", ".png")]
    others = ["flow/0001.npz", "flow/0002.npz", *(f"pictures/{k}/0001.png" for k in kinds)]
    others += ["moving/0001.png", "moving/0002.png"]
    tables = ["frames.csv", "job.json", "strip.mp4", "summary.json", "trajectory.txt"]
    written = {str(path.relative_to(out)) for path in out.rglob("*") if path.is_file()}
    assert written == {*flows, *others, *tables}
    assert not (tmp_path / "out.partial").exists()
    for name, moment in zip(("0001", "0002"), moments[1:]):
        np.testing.assert_array_equal(read_flow(out / f"flow/raw/{name}.flo"), moment.raw)
        obj = read_flow(out / f"flow/obj/{name}.flo")
        np.testing.assert_allclose(obj, moment.obj, atol=2e-4)
        np.testing.assert_allclose(read_flow(out / f"flow/obj/{name}.png"), obj, atol=1 / 128)
        arrays = np.load(out / f"flow/{name}.npz")
        np.testing.assert_allclose(arrays["ego"] + arrays["obj"], moment.raw, atol=1e-5)
        assert arrays["valid"].all()
        assert arrays["ego_valid"].all()
    # 0.3 m ahead on a curve: the pose before, seen from the pose now.
    expected = np.linalg.inv(synthetic.pose(0)) @ synthetic.pose(1)
    np.testing.assert_allclose(np.load(out / "flow/0001.npz")["prev_from_curr"], expected)
    assert len(imageio.imread(out / "strip.mp4", plugin="FFMPEG")) == 2
    rows = table(out)
    names = ["index", "name", "timestamp_s", "gap"]
    names += [f"{kind}_median_{unit}" for unit in ("px", "px_per_s") for kind in kinds]
    names += ["valid_share", "moving_share", "epe_px", "inlier_share", "recorded_obj_median_px"]
    assert list(rows[0]) == [*names, "rotation_off_deg", "translation_off_m"]
    assert [row["name"] for row in rows] == ["0001", "0002"]
    for row, moment in zip(rows, moments[1:]):
        moving = np.hypot(*moment.obj) > 0.01
        assert float(row["moving_share"]) == pytest.approx(moving.mean())
        mask = cv2.imread(str(out / f"moving/{row['name']}.png"), cv2.IMREAD_UNCHANGED)
        np.testing.assert_array_equal(mask, np.where(moving, 255, 0))
        assert row["gap"] == "0"
        # The frames are a tenth of a second apart.
        assert float(row["raw_median_px_per_s"]) == pytest.approx(10 * float(row["raw_median_px"]))
    lines = np.loadtxt(out / "trajectory.txt")
    np.testing.assert_allclose(lines[:, 0], [0.0, 0.1, 0.2])
    for line, moment in zip(lines, moments, strict=True):
        np.testing.assert_allclose(line[1:4], moment.world_from_cam[:3, 3], atol=1e-6)
        expected = synthetic.quaternion_line(moment.world_from_cam).split()
        np.testing.assert_allclose(line[4:], [float(x) for x in expected[3:]], atol=1e-6)
    summary = json.loads((out / "summary.json").read_text())
    assert (summary["frames"], summary["suspects"]) == (2, [])


def test_a_wrong_convention_ends_the_job_if_asked_and_else_is_a_warning(moments, tmp_path, capsys):
    wrong = ["format.pose_direction=world_to_camera", "video=false", "flow_files=[]"]
    wrong += ["flow=exact", "pictures_every=0"]
    code, out = factorize(tmp_path, *wrong, "check=error")
    said = capsys.readouterr()
    assert code == 2
    assert "format.pose_direction=camera_to_world" in said.out
    assert "check=warn" in said.err
    assert sorted(path.name for path in tmp_path.iterdir()) == ["in"]
    code, out = factorize(tmp_path, *wrong)
    assert code == 0
    assert capsys.readouterr().out.startswith("wrong: ")
    summary = json.loads((out / "summary.json").read_text())
    assert summary["suspects"][0] == "pose_direction=camera_to_world"
    assert summary["diagnosis"].startswith("wrong: ")


def test_poses_that_are_not_used_are_not_judged(moments, tmp_path):
    wrong = ["format.pose_direction=world_to_camera", "poses=estimated", "flow=exact"]
    code, _ = factorize(tmp_path, *wrong, "video=false")
    assert code == 0


@pytest.mark.parametrize(("number", "code"), [(signal.SIGINT, 130), (signal.SIGTERM, 143)])
def test_a_signal_keeps_the_frames_that_are_done(
    number, code, moments, tmp_path, monkeypatch, capsys
):
    append = Output.append

    def interrupted(self, *arguments):
        append(self, *arguments)
        signal.raise_signal(number)

    monkeypatch.setattr(Output, "append", interrupted)
    ended, out = factorize(tmp_path, "flow=exact")
    assert ended == code
    assert "out.partial" in capsys.readouterr().out
    assert not out.exists()
    partial = tmp_path / "out.partial"
    assert [row["name"] for row in table(partial)] == ["0001"]
    assert len(imageio.imread(partial / "strip.mp4", plugin="FFMPEG")) == 1
    with pytest.raises(SequenceError, match=r"out\.partial"):
        factorize(tmp_path, "flow=exact")


def test_the_folder_of_a_job_killed_before_its_first_frame_is_used_again(tmp_path):
    partial = tmp_path / "out.partial"
    partial.mkdir()
    (partial / "job.json").write_text("{}")
    Output(tmp_path / "out", {}).close()
    partial.mkdir()
    (partial / "job.json").write_text("{}")
    (partial / "frames.csv").write_text("frame\n")
    with pytest.raises(SequenceError, match="exists already"):
        Output(tmp_path / "out", {})


@pytest.mark.parametrize("folder", ["out", ".", "..", "/", "link"])
def test_an_existing_output_is_not_overwritten(folder, tmp_path):
    (tmp_path / "out").mkdir()
    (tmp_path / "link").symlink_to("nowhere")
    with pytest.raises(SequenceError, match=re.escape(folder)):
        Output(tmp_path / folder if folder.isalpha() else folder, {})


@pytest.mark.parametrize(
    ("overrides", "named"),
    [
        (["start=2"], "start=2"),  # one frame alone
        (["flow=exact", "stride=2"], "0001.*0000"),  # flow of its own does not skip frames
        (["flow=exact", "poses=estimated"], r"depth/0002\.png"),  # broken
    ],
)
def test_a_recording_that_cannot_be_factorised_is_named_and_writes_nothing(
    moments, tmp_path, overrides, named
):
    path = tmp_path / "in/depth/0002.png"
    if named.startswith("depth"):
        path.write_bytes(path.read_bytes()[:50])
    with pytest.raises((SequenceError, ValueError), match=named):
        factorize(tmp_path, *overrides, "video=false")
    assert sorted(path.name for path in tmp_path.iterdir()) == ["in"]


def test_an_estimated_trajectory_begins_with_the_recorded_pose(moments, tmp_path):
    options = ["poses=estimated", "video=false", "flow_files=[]"]
    _, out = factorize(tmp_path, "flow=exact", *options)
    for line, moment in zip(np.loadtxt(out / "trajectory.txt"), moments, strict=True):
        np.testing.assert_allclose(line[1:4], moment.world_from_cam[:3, 3], atol=2e-3)


def test_a_mask_of_moving_pixels_is_grey_where_flow_is_unknown(moments, tmp_path):
    flow = moments[1].raw.copy()
    flow[:, 3, 4] = np.nan
    synthetic.put(tmp_path / "in/flow/0001.flo", flow)
    _, out = factorize(tmp_path, "flow=exact", "video=false", "moving_px=0.01")
    mask = cv2.imread(str(out / "moving/0001.png"), cv2.IMREAD_UNCHANGED)
    moving = np.hypot(*moments[1].obj) > 0.01
    expected = np.where(moving, 255, 0)
    expected[3, 4] = 127
    np.testing.assert_array_equal(mask, expected)
    shutil.rmtree(out)
    factorize(tmp_path, "flow=exact", "video=false", "masks=false")
    assert not (out / "moving").exists()


@pytest.mark.parametrize(("stride", "names"), [(1, ["0001", "0002"]), (2, ["0002"])])
def test_estimated_flow_is_scored_against_the_recordings_own(moments, tmp_path, stride, names):
    _, out = factorize(tmp_path, f"stride={stride}", "video=false", "check_consistency=false")
    rows = table(out)
    assert [row["name"] for row in rows] == names
    # Of noise nothing can be seen; over two frames there is no flow of its own.
    assert all(float(row["epe_px"]) > 0.5 if stride == 1 else row["epe_px"] == "" for row in rows)


def test_a_camera_whose_skipped_frame_begins_a_clip_gives_no_pair_across_it(tmp_path):
    K, depth = np.array([[8.0, 0, 4], [0, 8, 3], [0, 0, 1]]), np.ones((6, 8), np.float32)
    camera = [Frame(f"{i}", Path("camera"), np.eye(4), K, depth, clip=int(i > 2)) for i in range(7)]
    pairs = []

    def flow_source(previous, current):
        pairs.append((previous.name, current.name))
        return np.zeros((2, 6, 8), np.float32)

    out = Output(tmp_path / "out", {})
    Job(camera, flow_source, recorded_motion, out, stop=7, stride=2).run()  # 0, 2, 4 and 6
    assert pairs == [("0", "2"), ("4", "6")]


def test_clips_of_another_size_are_factorised_too(tmp_path):
    synthetic.write_kitti(tmp_path / "in")
    for path in [*(tmp_path / "in").rglob("000000*")]:
        other = path.with_name(path.name.replace("000000", "000001"))
        if path.suffix == ".png":
            assert cv2.imwrite(str(other), cv2.imread(str(path), cv2.IMREAD_UNCHANGED)[:-2])
        else:
            shutil.copy(path, other)
    code, out = factorize(tmp_path, "flow=exact", format="kitti")
    assert code == 0
    assert [row["name"] for row in table(out)] == ["000000_10", "000001_10"]
    assert read_flow(out / "flow/obj/000001_10.flo").shape == (2, 22, 40)


def test_exact_flow_of_a_recording_without_flow_is_refused(tmp_path):
    synthetic.write_sintel(tmp_path / "in")
    given = ["format.scene=cave", "flow=exact", "video=false"]
    with pytest.raises(UsageError, match=r"format\.backwards=true"):
        factorize(tmp_path, *given, format="sintel")
    code, out = factorize(tmp_path, *given, "format.backwards=true", format="sintel")
    assert code == 0
    assert [row["name"] for row in table(out)] == ["frame_0002", "frame_0001"]
    shutil.rmtree(tmp_path / "in/flow")
    with pytest.raises(UsageError, match=r"in/flow/cave") as caught:
        factorize(tmp_path, *given, "format.backwards=true", format="sintel")
    assert "backwards" not in str(caught.value)


def test_without_poses_the_cameras_motion_is_estimated(moments, tmp_path, capsys):
    (tmp_path / "in/poses.txt").unlink()
    with pytest.raises(UsageError, match="poses=estimated"):
        factorize(tmp_path, "flow=exact", "poses=recorded", "video=false")
    code, out = factorize(tmp_path, "flow=exact", "video=false", "flow_files=[npz]")
    assert code == 0
    assert "estimated" in capsys.readouterr().out
    expected = np.linalg.inv(synthetic.pose(0)) @ synthetic.pose(1)
    estimated = np.load(out / "flow/0001.npz")["prev_from_curr"]
    np.testing.assert_allclose(estimated, expected, atol=1e-3)
    # Chained from the identity: poses relative to the first camera.
    last = np.loadtxt(out / "trajectory.txt")[2]
    relative = np.linalg.inv(synthetic.pose(0)) @ synthetic.pose(2)
    np.testing.assert_allclose(last[1:4], relative[:3, 3], atol=2e-3)
    for row in table(out):
        assert float(row["inlier_share"]) > 0.7
        assert row["rotation_off_deg"] == row["recorded_obj_median_px"] == ""
        assert float(row["obj_median_px"]) < 0.01


@pytest.mark.parametrize(
    ("key", "value"),
    [
        ("stop", "1"), ("scale_px.obj", "-2"), ("flow_files", "[flo,exr]"), ("flow.preset", "best"),
        ("format.pose_axes", "left_handed"), ("format.depth_kind", "null"), ("+format.scale", "2"),
        ("format._target_", "flowrep.sequences.Frame"),
    ],
)  # fmt: skip
def test_an_impossible_option_is_refused_by_name(key, value, moments, tmp_path):
    with pytest.raises(ValueError, match=key.removeprefix("+").replace("flow.", "")):
        factorize(tmp_path, f"{key}={value}")


@pytest.mark.parametrize("name", group_choices("format"))
def test_a_format_gives_options_of_its_reader_and_the_plain_layout_all(name):
    options = OmegaConf.to_container(OmegaConf.load(CONF_DIR / "format" / f"{name}.yaml"))
    _, *parameters = inspect.signature(get_class(declaration(name)["_target_"])).parameters.values()
    if options.pop("defaults", None) is None:
        del options["_target_"]
        assert list(options) == [p.name for p in parameters]
        for p in parameters:  # the code formats have defaults of their own
            assert p.default in (p.empty, options[p.name])
    else:
        assert {*options} <= {p.name for p in parameters}
    # Composed by Hydra, a format is what the same name gives in Python.
    keys = declaration(name)
    needed = [key for key, value in keys.items() if value == "needed"]
    given = [f"format={name}", "input=x", "output=y", *(f"format.{key}=1" for key in needed)]
    composed = settings(*given).format.options()
    assert composed == {k: 1 if k in needed else v for k, v in keys.items() if k != "_target_"}
    for key in needed:
        with pytest.raises(ValueError, match=rf"format\.{key}=\.\.\."):
            open_stream(settings(*(text for text in given if not text.startswith(f"format.{key}"))))


EXPECTED = {"frames": "depth/*, ", "tum": "depth.txt", "kitti": "image_2"}


@pytest.mark.parametrize("format", EXPECTED)
def test_a_wrong_folder_is_told_what_was_expected(format, tmp_path):
    file = tmp_path / "file"
    file.touch()
    for folder in (tmp_path, file):
        with pytest.raises(SequenceError) as refused:
            open_recording(folder, format)
        assert EXPECTED[format] in str(refused.value)
        assert "Errno" not in str(refused.value)


def test_a_format_of_ones_own_says_what_is_different(moments, tmp_path, monkeypatch):
    # As the plain layout, but with left/, metric.npy depth in decimetres, and OpenCV's intrinsics.
    folder = tmp_path / "in"
    (folder / "rgb").rename(folder / "left")
    for path in (folder / "depth").iterdir():
        depth = 10 * moments[int(path.stem)].depth
        path.unlink()
        np.save(folder / f"depth/z_{path.stem}.npy", depth)
    own = ["defaults: [frames, _self_]", "rgb: left/*", "depth: depth/z_*.npy"]
    own += ["depth_unit_m: 0.1", "intrinsics: [31.0, 27.0, 18.0, 12.5]", "first_pixel_centre: 0.0"]
    synthetic.put(tmp_path / "conf/format/mine.yaml", own)
    out = tmp_path / "out"
    line = ["python", "flowrep.factorize", "--config-dir", str(tmp_path / "conf"), "format=mine"]
    line += ["flow=exact", "video=false", f"input={folder}", f"output={out}"]
    assert run_here(monkeypatch, line) == 0
    for moment, name in zip(moments[1:], ("0001", "0002")):
        obj = read_flow(out / f"flow/obj/{name}.flo")
        np.testing.assert_allclose(obj, moment.obj, atol=2e-4)


def test_the_format_of_ones_own_in_the_docs_has_keys_that_there_are():
    page = (CONF_DIR.parent / "docs/factorize.md").read_text(encoding="utf-8")
    (block,) = re.findall(r"```yaml\n(defaults.*?)```", page, re.DOTALL)
    keys = OmegaConf.to_container(OmegaConf.create(block))
    assert keys.pop("defaults") == ["frames", "_self_"]
    assert keys.keys() <= declaration("frames").keys()


def test_a_still_camera_needs_neither_poses_nor_depth(tmp_path):
    # A texture before which another goes 2 px to the right each frame.
    random = np.random.default_rng(0)
    ground = cv2.resize(random.integers(0, 256, (24, 32, 3), dtype=np.uint8), (128, 96))
    body = cv2.resize(random.integers(0, 256, (10, 10, 3), dtype=np.uint8), (40, 40))
    frames = np.stack([ground] * 3)
    for i, frame in enumerate(frames):
        frame[30:70, 20 + 2 * i : 60 + 2 * i] = body
    imageio.imwrite(tmp_path / "in.mp4", frames, plugin="FFMPEG", fps=10, quality=10)
    still = ["format.still=true", "video=false", "flow_files=[npz]"]
    code, out = factorize(tmp_path, *still, source="in.mp4", format="video")
    assert code == 0
    arrays = np.load(out / "flow/000002.npz")
    assert (arrays["ego"] == 0).all()
    inside_px = np.median(arrays["obj"][:, 40:60, 32:54], axis=(1, 2))
    np.testing.assert_allclose(inside_px, [2.0, 0.0], atol=0.3)
    shutil.rmtree(out)
    factorize(tmp_path, *still, "stride=2", source="in.mp4", format="video")
    assert table(out)[0]["gap"] == "1"
    assert np.loadtxt(out / "trajectory.txt")[:, 0].tolist() == [0, 2]


@needs_7scenes
def test_a_real_static_room_has_little_object_flow(tmp_path):
    options = ["stride=2", "stop=3", "video=false", "poses=estimated"]
    _, out = factorize(tmp_path, *options, source=SEVEN_SCENES, format="sevenscenes")
    (row,) = table(out)
    assert row["name"] == "frame-000102"
    raw_px, obj_px = float(row["raw_median_px"]), float(row["obj_median_px"])
    # The recorded poses leave 0.16 of raw; the motion of flow and depth does better.
    assert obj_px <= 0.12 * raw_px
    assert obj_px < float(row["recorded_obj_median_px"]) < 0.25 * raw_px
    # Nothing moves: the share of movers counts the frame's own error out.
    assert float(row["moving_share"]) < 0.2
    assert json.loads((out / "summary.json").read_text())["suspects"] == []
