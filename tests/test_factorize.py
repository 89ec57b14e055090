"""`python -m flowrep.factorize` from a folder to flow files, pictures, a video and a table."""

from __future__ import annotations

import csv
import inspect
import json
import re
import shutil
import signal
import subprocess
import sys
import time
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch
from hydra.utils import get_class
from omegaconf import OmegaConf

pytest.importorskip("cv2", reason="recordings need OpenCV")

import cv2
import imageio.v3 as imageio

from flowrep.config import UsageError, validated
from flowrep.config.composition import check_command
from flowrep.config.factorizing import FactorizeConfig
from flowrep.config_tree import CONF_DIR, group_choices
from flowrep.factorize import factorize_recording, main
from flowrep.sequences import (
    RECORDINGS,
    STREAMS,
    EstimatedFlowSource,
    Frame,
    SequenceError,
    SevenScenes,
    diagnose,
    factorize_pair,
    read_flo,
    read_kitti_flow,
)
from flowrep.sequences.job import Job, JobOptions
from flowrep.sequences.output import COLUMNS, OutputFolder
from flowrep.transforms import DIS
from tests.config.composing import plain
from tests.sequences import synthetic

SEVEN_SCENES = Path(__file__).resolve().parents[2] / "shared" / "data" / "7scenes"
needs_7scenes = pytest.mark.skipif(
    not SEVEN_SCENES.is_dir(), reason=f"no 7-Scenes frames at {SEVEN_SCENES}"
)


def settings(*overrides) -> dict:
    made = plain("factorize", *overrides)
    validated(FactorizeConfig, made)
    return made


def factorize(tmp_path, *overrides, source="in", format="frames"):
    out = tmp_path / "out"
    given = [f"input={tmp_path / source}", f"format={format}", f"output={out}"]
    return factorize_recording(settings(*given, *overrides)), out


def table(folder):
    with (folder / "frames.csv").open(newline="") as file:
        return list(csv.DictReader(file))


def files_of(folder):
    return sorted(str(p.relative_to(folder)) for p in folder.rglob("*") if p.is_file())


@pytest.fixture
def moments(tmp_path):
    return synthetic.write_frames(tmp_path / "in")


def test_all_that_is_written(moments, tmp_path):
    everything = ["flow_files=[flo,kitti,npz]", "pictures_every=2"]
    code, out = factorize(tmp_path, "flow=exact", *everything)
    assert code == 0
    kinds = ("raw", "ego", "obj")
    flows = [f"flow/{k}/{n}{s}" for k in kinds for n in ("0001", "0002") for s in (".flo", ".png")]
    others = ["flow/0001.npz", "flow/0002.npz", *(f"pictures/{k}/0002.png" for k in kinds)]
    tables = ["frames.csv", "job.json", "strip.mp4", "summary.json"]
    assert files_of(out) == sorted([*flows, *others, *tables])
    assert not (tmp_path / "out.partial").exists()
    for name, moment in zip(("0001", "0002"), moments[1:]):
        np.testing.assert_array_equal(read_flo(out / f"flow/raw/{name}.flo"), moment.raw)
        obj = read_flo(out / f"flow/obj/{name}.flo")
        np.testing.assert_allclose(obj, moment.obj, atol=2e-4)
        np.testing.assert_allclose(read_kitti_flow(out / f"flow/obj/{name}.png"), obj, atol=1 / 128)
        arrays = np.load(out / f"flow/{name}.npz")
        np.testing.assert_allclose(arrays["ego"] + arrays["obj"], moment.raw, atol=1e-5)
        assert arrays["valid"].all()
        assert arrays["ego_valid"].all()
    # 0.3 m ahead on a curve: the pose before, seen from the pose now.
    expected = np.linalg.inv(synthetic.pose(0)) @ synthetic.pose(1)
    np.testing.assert_allclose(np.load(out / "flow/0001.npz")["prev_from_curr"], expected)
    assert len(imageio.imread(out / "strip.mp4", plugin="FFMPEG")) == 2


def test_the_table_says_what_the_truth_is(moments, tmp_path):
    _, out = factorize(tmp_path, "flow=exact", "moving_px=0.01", "video=false")
    rows = table(out)
    assert tuple(rows[0]) == COLUMNS
    assert [row["name"] for row in rows] == ["0001", "0002"]
    for row, moment in zip(rows, moments[1:]):
        obj = np.hypot(*moment.obj)
        assert float(row["moving_share"]) == pytest.approx((obj > 0.01).mean())
        assert float(row["raw_median_px"]) == pytest.approx(
            np.quantile(np.hypot(*moment.raw), 0.5, method="lower"), rel=1e-4
        )
        assert float(row["epe_px"]) == 0.0
        assert float(row["valid_share"]) == 1.0
    summary = json.loads((out / "summary.json").read_text())
    assert summary["frames"] == 2
    assert summary["doctor"].startswith("conventions look right")


def test_a_wrong_convention_is_said(moments, tmp_path, capsys):
    wrong = ["format.pose_direction=world_to_camera", "video=false", "flow_files=[]"]
    _, out = factorize(tmp_path, "flow=exact", *wrong, "pictures_every=0")
    assert "warning: a convention looks wrong" in capsys.readouterr().out
    summary = json.loads((out / "summary.json").read_text())
    assert summary["suspects"][0] == "poses_inverted"


def test_estimated_flow_is_scored_against_the_recordings_own(moments, tmp_path):
    _, out = factorize(tmp_path, "video=false", "check_consistency=false")
    assert all(float(row["epe_px"]) > 0.5 for row in table(out))  # of noise nothing can be seen


def interrupted_after(frames, monkeypatch, tmp_path, *options):
    """Starts a job and ends it in its middle."""
    take = Job._take

    def taken(self, *arguments):
        if self.done >= frames:
            raise KeyboardInterrupt
        take(self, *arguments)

    with monkeypatch.context() as patch:
        patch.setattr(Job, "_take", taken)
        with pytest.raises(KeyboardInterrupt):
            factorize(tmp_path, *options)


@pytest.mark.slow_after_first
@pytest.mark.parametrize("video", [False, True])
def test_an_interrupted_job_is_continued(video, tmp_path, monkeypatch):
    monkeypatch.setattr(synthetic, "FRAMES", 6)
    synthetic.write_frames(tmp_path / "in")
    options = ["flow=exact", f"video={video}", "flow_files=[npz]"]
    _, whole = factorize(tmp_path, *options)
    whole.rename(tmp_path / "whole")
    interrupted_after(3, monkeypatch, tmp_path, *options)
    assert not (tmp_path / "out").exists()
    # A kill leaves half a row; the frame it was about is done again.
    with (tmp_path / "out.partial" / "frames.csv").open("a") as file:
        file.write("4,0004,,1.2")
    code, out = factorize(tmp_path, *options, "resume=true")
    assert code == 0
    assert table(out) == table(tmp_path / "whole")
    assert files_of(out) == files_of(tmp_path / "whole")
    if video:
        assert len(imageio.imread(out / "strip.mp4", plugin="FFMPEG")) == 5


@pytest.mark.slow
def test_a_killed_job_is_continued(tmp_path, monkeypatch):
    monkeypatch.setattr(synthetic, "FRAMES", 60)
    synthetic.write_frames(tmp_path / "in")
    options = ["video=false", "flow_files=[flo,npz]", "pictures_every=5"]
    _, whole = factorize(tmp_path, *options)
    whole.rename(tmp_path / "whole")
    rows = tmp_path / "out.partial/frames.csv"
    command = [sys.executable, "-m", "flowrep.factorize", "format=frames", *options]
    command += [f"input={tmp_path / 'in'}", f"output={tmp_path / 'out'}"]
    with subprocess.Popen(command, stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL) as job:
        deadline = time.monotonic() + 120
        while job.poll() is None and time.monotonic() < deadline:
            if rows.exists() and rows.read_bytes().count(b"\n") > 5:
                break
            time.sleep(0.002)
        job.kill()
    assert job.returncode == -signal.SIGKILL
    assert not (tmp_path / "out").exists()
    assert 5 <= len(table(tmp_path / "out.partial")) < 59
    code, out = factorize(tmp_path, *options, "resume=true")
    assert code == 0
    assert files_of(out) == files_of(tmp_path / "whole")
    for name in files_of(out):
        if name != "summary.json":  # which says where the time went
            assert (out / name).read_bytes() == (tmp_path / "whole" / name).read_bytes(), name
    summaries = [json.loads((f / "summary.json").read_text()) for f in (out, tmp_path / "whole")]
    assert summaries[0]["frames"] == summaries[1]["frames"] == 59
    assert summaries[0]["medians"] == summaries[1]["medians"]


def test_a_job_is_continued_as_it_was_started_alone(moments, tmp_path, monkeypatch):
    options = ["flow=exact", "video=false"]
    interrupted_after(1, monkeypatch, tmp_path, *options)
    with pytest.raises(SequenceError, match=r"out\.partial: is an unfinished job: resume=true"):
        factorize(tmp_path, *options)
    with pytest.raises(SequenceError, match="started with stride=1, not 2"):
        factorize(tmp_path, *options, "stride=2", "resume=true")


def test_what_is_there_is_not_overwritten(moments, tmp_path):
    (tmp_path / "out").mkdir()
    with pytest.raises(SequenceError, match="out: exists already"):
        factorize(tmp_path)


@pytest.mark.parametrize("folder", [".", "..", "/"])
def test_a_folder_without_a_name_is_not_overwritten(folder):
    with pytest.raises(SequenceError, match=f"^{re.escape(folder)}: exists already"):
        OutputFolder(folder, {}, resume=False)


def test_without_an_unfinished_job_there_is_nothing_to_continue(moments, tmp_path):
    with pytest.raises(SequenceError, match=r"out\.partial: is not there"):
        factorize(tmp_path, "resume=true")


def test_a_broken_file_leaves_nothing_that_looks_whole(moments, tmp_path):
    path = tmp_path / "in/depth/0002.png"
    path.write_bytes(path.read_bytes()[:50])
    with pytest.raises(SequenceError, match=r"depth/0002\.png: is a PNG that was cut off"):
        factorize(tmp_path, "flow=exact", "video=false")
    assert not (tmp_path / "out").exists()
    assert [row["name"] for row in table(tmp_path / "out.partial")] == ["0001"]
    synthetic.write_frames(tmp_path / "in")
    code, out = factorize(tmp_path, "flow=exact", "video=false", "resume=true")
    assert code == 0
    assert [row["name"] for row in table(out)] == ["0001", "0002"]


def test_a_first_frame_that_is_broken_leaves_nothing_at_all(moments, tmp_path):
    (tmp_path / "in/rgb/0000.png").write_bytes(b"")
    with pytest.raises(SequenceError, match=r"rgb/0000\.png: is empty"):
        factorize(tmp_path)
    assert sorted(path.name for path in tmp_path.iterdir()) == ["in"]


def test_one_frame_alone_has_no_flow(moments, tmp_path):
    with pytest.raises(SequenceError, match="no two consecutive frames of one clip with start=2"):
        factorize(tmp_path, "start=2", "video=false")
    assert sorted(path.name for path in tmp_path.iterdir()) == ["in"]


def test_flow_of_its_own_does_not_skip_frames(moments, tmp_path):
    with pytest.raises(SequenceError, match="has flow since frame 0001, and here follows 0000"):
        factorize(tmp_path, "flow=exact", "stride=2", "video=false")


def test_a_stride_takes_every_other_frame(moments, tmp_path):
    _, out = factorize(tmp_path, "stride=2", "video=false", "check_consistency=false")
    (row,) = table(out)
    assert (row["index"], row["name"], row["epe_px"]) == ("2", "0002", "")


def test_a_stride_does_not_pair_frames_of_two_clips(tmp_path):
    synthetic.write_kitti(tmp_path / "in")
    training, mapping = tmp_path / "in/training", tmp_path / "in/train_mapping.txt"
    for path in [*training.glob("*/000000*")]:  # a second pair
        shutil.copy(path, path.with_name(path.name.replace("000000", "000001")))
    mapping.write_text(2 * mapping.read_text())
    # frames in order: a later, a earlier, b later, b earlier; every third is the first and the last
    options = ["stride=3", "video=false"]
    options += [f"format.raw_data={tmp_path}/in/raw", f"format.mapping={mapping}"]
    with pytest.raises(SequenceError, match=r"no two .* frames of one clip with start=0 stride=3"):
        factorize(tmp_path, *options, source="in/training", format="kitti")


class Camera:
    """A stream whose fourth frame begins a clip."""

    has_flow, notes = False, ()

    def __iter__(self):
        for number in range(7):
            yield Frame(
                name=f"{number}",
                source=Path("camera"),
                world_from_cam=np.eye(4),
                K=np.array([[8.0, 0, 4], [0, 8, 3], [0, 0, 1]]),
                depth=np.ones((6, 8), np.float32),
                starts_clip=number == 3,
            )


def test_a_camera_whose_skipped_frame_begins_a_clip_gives_no_pair_across_it(tmp_path):
    pairs = []

    def flow_source(previous, current):
        pairs.append((previous.name, current.name))
        return np.zeros((2, 6, 8), np.float32)

    out = OutputFolder(tmp_path / "out", {}, resume=False)
    Job(Camera(), flow_source, out, JobOptions(stop=7, stride=2)).run()  # 0, 2, 4 and 6
    assert pairs == [("0", "2"), ("4", "6")]


def test_exact_flow_where_there_is_none(tmp_path):
    synthetic.write_sintel(tmp_path / "in")
    sintel = {"format": "sintel"}
    with pytest.raises(UsageError, match=r"flow=exact: .* format\.backwards=true"):
        factorize(tmp_path, "format.scene=cave", "flow=exact", **sintel)
    backwards = ["format.scene=cave", "format.backwards=true", "flow=exact", "video=false"]
    code, out = factorize(tmp_path, *backwards, **sintel)
    assert code == 0
    assert [row["name"] for row in table(out)] == ["frame_0002", "frame_0001"]


@pytest.mark.parametrize(
    ("override", "says"),
    [
        ("stride=0", "stride should be a positive whole number, not 0"),
        ("start=-1", "start should be a whole number from 0, not -1"),
        ("stop=1", "stop should be at least 2 for a pair, not 1"),
        ("pictures_every=often", "pictures_every should be a whole number from 0, not 'often'"),
        ("video=maybe", "video should be true or false, not 'maybe'"),
        ("moving_px=0", "moving_px should be a number above 0, not 0"),
        ("video_fps=inf", "video_fps should be a number above 0, not inf"),
        ("scale_px.obj=-2", "scale_px.obj should be a number above 0, not -2"),
        ("flow_files=[flo,exr]", "each flo, kitti or npz, not ['flo', 'exr']"),
        ("format.pose_axes=blender", "format.pose_axes should be opencv, opengl, ned or x_forward"),
        ("format.depth_kind=z_buffer", "format.near_m should be a number with depth_kind=z_buffer"),
        ("format.depth_unit_m=0", "format.depth_unit_m should be a number above 0, not 0"),
        ("flow.preset=best", "flow.preset should be ultrafast, fast or medium, not 'best'"),
    ],
)
def test_what_cannot_be_is_named(override, says):
    with pytest.raises(UsageError) as caught:
        settings("input=a", "output=b", "format=frames", override)
    assert says in str(caught.value)


@pytest.mark.parametrize(
    ("override", "says"),
    [
        ("format.intrinsics=[1,2,3]", "format.intrinsics should be [fx, fy, cx, cy] in pixels"),
        ("format.tolerance_s=-1", "format.tolerance_s should be a number from 0, not -1"),
    ],
)
def test_what_cannot_be_of_a_format_is_named(override, says):
    with pytest.raises(UsageError) as caught:
        settings("input=a", "output=b", "format=tum", override)
    assert says in str(caught.value)


def test_flow_on_the_other_grid_is_refused(moments, tmp_path):
    with pytest.raises(ValueError, match="previous frame's grid cannot be turned"):
        factorize(tmp_path, "format.flow_grid=previous")
    assert sorted(path.name for path in tmp_path.iterdir()) == ["in"]


@pytest.mark.parametrize(
    ("override", "says"),
    [
        ("stride=0", "stride should be a positive whole number, not 0"),
        ("format.scale=2", "unknown key 'scale' of 'format'"),
    ],
)
def test_a_command_line_is_refused_by_name(override, says):
    with pytest.raises(UsageError, match=says):
        check_command("factorize", ["input=a", "output=b", "format=tum", override], FactorizeConfig)


def test_unknown_formats_are_refused_and_the_known_ones_listed():
    with pytest.raises(UsageError, match=r"unknown format 'tumm' \(did you mean 'tum'"):
        check_command("factorize", ["input=a", "output=b", "format=tumm"], FactorizeConfig)
    assert set(group_choices("format")) == {*RECORDINGS, *STREAMS}


@pytest.mark.parametrize("name", [*RECORDINGS, *STREAMS])
def test_a_format_spells_out_every_option_of_its_reader_in_its_order(name):
    options = OmegaConf.to_container(OmegaConf.load(CONF_DIR / "format" / f"{name}.yaml"))
    reader = get_class(options.pop("_target_"))
    assert reader is (RECORDINGS | STREAMS)[name]
    _, *parameters = inspect.signature(reader).parameters.values()
    defaults = {
        p.name: "???" if p.default is p.empty else
        list(p.default) if isinstance(p.default, tuple) else p.default
        for p in parameters
    }  # fmt: skip
    assert list(options.items()) == list(defaults.items())


@pytest.mark.parametrize(
    ("arguments", "says"),
    [
        (["input=nowhere", "output=out"], "'format' needs a value: format=...; there are: frames"),
        (["format=tum", "output=out"], "'input' needs a value"),
        (["format=tum", "input=nowhere", "output=out"], "nowhere: no such folder"),
    ],
)  # fmt: skip
def test_the_command_ends_with_one_line_and_code_2(arguments, says, tmp_path, monkeypatch, capsys):
    monkeypatch.setattr(sys, "argv", ["flowrep-factorize", *arguments])
    monkeypatch.chdir(tmp_path)
    with pytest.raises(SystemExit) as ended:
        main()
    said = capsys.readouterr().err
    assert ended.value.code == 2
    assert said.count("\n") == 1, said
    assert said.startswith("error: ")
    assert says in said
    assert list(tmp_path.iterdir()) == []


def test_a_still_camera_needs_neither_poses_nor_depth(tmp_path):
    # A texture before which another goes 2 px to the right each frame.
    random = np.random.default_rng(0)
    ground = cv2.resize(random.integers(0, 256, (24, 32, 3), dtype=np.uint8), (128, 96))
    body = cv2.resize(random.integers(0, 256, (10, 10, 3), dtype=np.uint8), (40, 40))
    frames = []
    for i in range(3):
        frame = ground.copy()
        frame[30:70, 20 + 2 * i : 60 + 2 * i] = body
        frames.append(frame)
    imageio.imwrite(tmp_path / "in.mp4", np.stack(frames), plugin="FFMPEG", fps=10, quality=10)
    still = ["format.still=true", "video=false", "flow_files=[npz]"]
    code, out = factorize(tmp_path, *still, source="in.mp4", format="video")
    assert code == 0
    arrays = np.load(out / "flow/000002.npz")
    assert (arrays["ego"] == 0).all()
    inside = arrays["obj"][:, 40:60, 32:54]
    assert np.median(inside[0]) == pytest.approx(2.0, abs=0.3)
    assert abs(np.median(inside[1])) < 0.3


@pytest.mark.slow_after_first
@needs_7scenes
@pytest.mark.parametrize(("stride", "pair"), [(1, "frame-000101"), (2, "frame-000102")])
def test_a_real_static_room_has_little_object_flow(stride, pair, tmp_path):
    options = [f"stride={stride}", f"stop={stride + 1}", "video=false", "flow_files=[npz]"]
    out = tmp_path / "out"
    given = [f"input={SEVEN_SCENES}", "format=sevenscenes", f"output={out}"]
    factorize_recording(settings(*given, *options))
    (row,) = table(out)
    assert row["name"] == pair
    raw_px = float(row["raw_median_px"])
    assert float(row["obj_median_px"]) < 0.35 * raw_px
    assert json.loads((out / "summary.json").read_text())["suspects"] == []
    # The rivals: the sign turned, and poses read as world-to-camera.
    arrays = np.load(out / f"flow/{pair}.npz")
    valid = arrays["valid"]
    wrong_sign = np.hypot(*(-arrays["raw"] - arrays["ego"]))[valid]
    assert np.median(wrong_sign) > 0.35 * raw_px
    recording = SevenScenes(SEVEN_SCENES)
    inverted = [
        replace(frame, world_from_cam=np.linalg.inv(frame.world_from_cam))
        for frame in (recording[0], recording[stride])
    ]
    made = factorize_pair(*inverted, arrays["raw"])
    assert made.valid.sum() > 0.9 * valid.sum()
    assert np.median(np.hypot(*made.obj)[made.valid]) > 0.35 * raw_px


@needs_7scenes
@pytest.mark.parametrize(("factor", "named"), [(1000, "depth_times_0.001"), (0.2, "depth_times_5")])
def test_the_doctor_names_a_wrong_unit_of_real_depth(factor, named):
    recording = SevenScenes(SEVEN_SCENES)
    pair = recording[0], recording[1]
    raw = EstimatedFlowSource(DIS("fast"))(*pair)
    poses = [torch.from_numpy(frame.world_from_cam) for frame in pair]
    depth = torch.from_numpy(factor * pair[1].depth)[None]
    diagnosis = diagnose(torch.from_numpy(raw), depth, torch.from_numpy(pair[1].K), *poses)
    assert diagnosis.suspects == (named,)
