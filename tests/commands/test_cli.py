"""The command line: help at once, clear refusals, nothing half-written. Heavy commands are run small."""

import dataclasses
import functools
import hashlib
import importlib.metadata
import json
import re
import shlex
import shutil
import signal
import subprocess
import sys
import time

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from PIL import Image

from ssplat_jax import __version__
from ssplat_jax.commands import train_command
from ssplat_jax.commands.main import COMMANDS, guarded, main
from ssplat_jax.commands.options import apply_changes, causal_changes
from ssplat_jax.commands.start import start
from ssplat_jax.config import StreamConfig, preset
from ssplat_jax.core.errors import InputError
from ssplat_jax.core.gaussians import Gaussians, mask_gaussians
from ssplat_jax.data import capture_summary
from ssplat_jax.data.capture_summary import summarize
from ssplat_jax.evaluation import cost, evaluate
from ssplat_jax.model.streamsplat import StreamSplat
from ssplat_jax.refinement import refine_on_capture
from ssplat_jax.scene_files.formats import load_ply, save_ply
from ssplat_jax.storage.chunk_records import load_delta, load_delta_header
from ssplat_jax.storage.published_weights import as_published, published_tensors
from ssplat_jax.storage.run_folder import RunFolder
from ssplat_jax.storage.saved_states import load_state
from ssplat_jax.storage.weights import load_params, load_weights, save_weights
from ssplat_jax.streaming.scene_delta import apply_delta
from tests.model.resplat_fixture import named_tensor
from tests.scene_files import scene_fixture


@pytest.fixture(autouse=True)
def few_pivots(monkeypatch):
    """Scenes this small are not decoded and rendered at the size of large ones."""
    monkeypatch.setattr("ssplat_jax.streaming.session.MIN_DECODED_PIVOTS", 1 << 11)


def run(*arguments: str) -> int:
    with pytest.raises(SystemExit) as stopped:
        main(list(arguments))
    return int(stopped.value.code or 0)


def make_capture(folder, num_frames=6, size=(32, 24)):
    """A small valid transforms.json capture: a camera sliding along a chequered wall, three pixels a frame."""
    width, height = size
    cells = np.random.default_rng(0).integers(0, 255, (height // 4, width // 4 + num_frames, 3), dtype=np.uint8)
    wall = cells.repeat(4, axis=0).repeat(4, axis=1)
    (folder / "images").mkdir(parents=True)
    frames = []
    for i in range(num_frames):
        Image.fromarray(wall[:, 3 * i : 3 * i + width]).save(folder / "images" / f"{i}.png")
        pose = np.eye(4)
        pose[0, 3] = 0.1 * i
        frames.append({"file_path": f"images/{i}.png", "transform_matrix": pose.tolist()})
    facts = {"w": width, "h": height, "fl_x": float(width), "fl_y": float(width), "cx": width / 2, "cy": height / 2}
    facts["frames"] = frames
    (folder / "transforms.json").write_text(json.dumps(facts))
    return folder


@pytest.mark.parametrize("command", [(), *((c,) for c in COMMANDS)])
def test_help_does_not_import_jax_and_shows_an_example(command):
    code = (
        "import sys\nfrom ssplat_jax.commands.main import main\n"
        f"sys.argv = ['ssplat', *{command!r}, '--help']\n"
        "try:\n    main()\nexcept SystemExit as stop:\n    assert not stop.code\n"
        "assert 'jax' not in sys.modules, 'help imported jax'\n"
    )
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    if command:
        assert f"Example: ssplat {command[0]}" in " ".join(done.stdout.split())


@pytest.mark.slow
def test_help_answers_within_a_second():
    since = time.perf_counter()
    subprocess.run([sys.executable, "-m", "ssplat_jax.commands.start", "--help"], capture_output=True, check=True)
    assert time.perf_counter() - since < 1.0


def test_version_names_what_a_report_of_an_error_needs(capsys):
    assert run("--version") == 0
    words = capsys.readouterr().out.split()
    assert words[:2] == ["ssplat", __version__]
    assert words[2:4] == ["(jax", f"{importlib.metadata.version('jax')},"]


def test_output_that_nobody_reads_ends_a_command_quietly():
    code = "from ssplat_jax.commands.start import start; start()"
    command = [sys.executable, "-c", code, "--help"]
    with subprocess.Popen(command, stdout=subprocess.PIPE, stderr=subprocess.PIPE) as process:
        assert process.stdout is not None and process.stderr is not None
        process.stdout.close()
        assert (process.stderr.read(), process.wait()) == (b"", 128 + signal.SIGPIPE)


def truncate(capture):
    path = capture / "images" / "2.png"
    path.write_bytes(path.read_bytes()[:200])


def edit(field, value):
    def change(capture):
        facts = json.loads((capture / "transforms.json").read_text())
        target = facts if field in facts else facts["frames"][1]
        target[field] = value
        (capture / "transforms.json").write_text(json.dumps(facts))

    return change


SHEARED = [[1, 0.5, 0, 0], [0, 1, 0, 0], [0, 0, 1, 0], [0, 0, 0, 1]]
NAN_POSE = [[1, 0, 0, float("nan")], [0, 1, 0, 0], [0, 0, 1, 0], [0, 0, 0, 1]]
BAD_CAPTURES = {
    "missing image": (lambda c: (c / "images" / "3.png").unlink(), "3.png"),
    "truncated image": (truncate, "2.png"),
    "NaN pose": (edit("transform_matrix", NAN_POSE), "transform_matrix"),
    "non-rotation pose": (edit("transform_matrix", SHEARED), "transform_matrix"),
    "focal zero": (edit("fl_x", 0.0), "fl_x"),
    "size differs": (edit("w", 64), "64"),
    "empty folder": (lambda c: [shutil.rmtree(c), c.mkdir()], "empty"),
    "path outside": (edit("file_path", "../../secret.png"), "secret"),
}


@pytest.mark.parametrize("case", BAD_CAPTURES)
@pytest.mark.parametrize("command", ["eval", "run"])
def test_bad_capture_is_one_line_exit_2_and_nothing_written(case, command, tmp_path, capsys):
    capture = make_capture(tmp_path / "capture")
    spoil, named = BAD_CAPTURES[case]
    spoil(capture)
    out = tmp_path / "out"
    options = ("--context", "5") if command == "eval" else ()
    # Fresh weights: refusing must not depend on the shipped ones.
    code = run(command, str(capture), *options, "--out", str(out))
    captured = capsys.readouterr()
    assert code == 2
    lines = [line for line in captured.err.splitlines() if line.strip()]
    assert len(lines) == 1 and named in lines[0], captured.err
    assert not out.exists()


@pytest.mark.parametrize("place", ["views", "deltas", "images"])
@pytest.mark.parametrize("command", ["eval", "run"])
def test_results_among_the_captures_own_images_are_refused(command, place, tmp_path, capsys):
    """A run overwrites and clears files of its folder, so its images must not lie there."""
    make_capture(tmp_path / place)
    before = {path: path.read_bytes() for path in tmp_path.rglob("*.*")}
    options = ("--context", "5") if command == "eval" else ("--overwrite",)
    for out in (tmp_path, tmp_path / place, tmp_path / place / "images", tmp_path / place / "images" / "sub"):
        assert run(command, str(tmp_path / place), *options, "--out", str(out)) == 2
        (line,) = capsys.readouterr().err.splitlines()
        assert "--out" in line
    assert {path: path.read_bytes() for path in tmp_path.rglob("*.*")} == before


@pytest.mark.parametrize(
    ("arguments", "named"),
    [
        ((), "Expected one of {demo"),
        (("rnu",), "run"),
        (("run", "x", "--out", "y", "--szie", "3"), "--size"),
        (("run", "x", "--out", "y", "--quality", "superb"), "balanced"),
        (("run",), "CAPTURE"),
    ],
)
def test_usage_that_does_not_parse_is_short_and_exit_2(arguments, named, capsys):
    assert run(*arguments) == 2
    told = capsys.readouterr().err
    assert named in told and len(told.splitlines()) < 14


@pytest.mark.parametrize(
    ("arguments", "named"),
    [
        (("inspect", "no/such/folder"), "no/such/folder"),
        (("inspect", "procedural:room", "--size", "100000x100000"), "16384"),
        (("inspect", "procedural:room", "--size", "9000x9000"), "64,000,000"),
        (("eval", "procedural:room", "--context", "5", "--size", "huge", "--out", "x"), "--size"),
        (("eval", "procedural:room?frames=12&size=32x24", "--context", "5000", "--out", "x"), "context"),
        (("eval", "procedural:room", "--context", "8", "--set", "voxel_size=-1", "--out", "x"), "voxel_size"),
        (("eval", "procedural:room", "--context", "8", "--set", "no_such=1", "--out", "x"), "no_such"),
        (("eval", "procedural:room", "--context", "8", "--weights", "no.npz", "--out", "x"), "no.npz"),
        (("eval", "procedural:room", "--context", "8", "--lpips-vgg", "vgg.pth", "--out", "x"), "--lpips-heads"),
        (("train", "--lpips-vgg", "no.pth", "--lpips-heads", "heads.pth", "--out", "x"), "no.pth"),
        (("train", "--validate-every", "5", "--out", "x"), "--validate-every: wanted --captures"),
        (("run", "x", "--watch", "--revise", "auto", "--refine", "5", "--out", "x"), "--revise auto: wanted a capture"),
        (("run", "x", "--watch", "--axes", "opencv", "--out", "x"), "got --axes or --poses"),
        (("run", "x?poses=world-to-camera", "--watch", "--out", "x"), "got ?axes= or ?poses= behind the capture"),
        (("bench", "stream", "--scaling"), "--scaling: bench stream has no use for it"),
        (("bench", "refine", "--full-hd"), "--full-hd: bench refine has no use for it"),
        (("bench", "stream", "--against", "x"), "--against: bench stream has no use for it"),
        (("run", "procedural:room?frames=2&size=32x24", "--stride", "0", "--out", "x"), "--stride"),
        (("run", "procedural:room?frames=2&size=32x24", "--save-every", "0", "--out", "x"), "--save-every"),
        (("run", "procedural:room?frames=2&size=32x24", "--max-views", "-1", "--out", "x"), "--max-views"),
        (("run", "procedural:room?frames=2&size=10x10", "--out", "x"), "11 pixels"),
        (("run", "procedural:room?frames=1&size=32x24", "--out", "x"), "wanted two frames or more to stream, got 1"),
        (("run", "procedural:room?frames=9&size=32x24", "--max-views", "1", "--out", "x"), "two frames or more"),
        (("train", "--scale-steps", "0", "--out", "x"), "--scale-steps"),
        (("run", "procedural:room", "--set", "capacity=65536.0", "--out", "x"), "capacity"),
        (("run", "procedural:room", "--set", "chunk_size=4.5", "--out", "x"), "chunk_size"),
        (("run", "procedural:room", "--set", "sh_degree=1", "--out", "x"), "another config"),
        (("train", "--set", "encoder_widths=[16, 0]", "--out", "x"), "encoder_widths"),
        (("export", "no_run", "--to", "x.ply"), "no_run"),
        (("import-weights", "no.pth", "--out", "x.npz"), "no.pth: cannot be read"),
        (("run", "procedural:room", "--weights", "small", "--out", "x"), "none ship with the preset 'small'"),
        (("inspect", "procedural:castle"), "castle"),
        (("run", "x", "--out", "y", "--set", "a=1", "--revise", "poses", "--set", "b=2"), "wanted --set once, got it"),
        (("run", "procedural:room", "--causal", "--revise", "poses", "--out", "x"), "--revise poses: wanted a stream"),
        (("eval", "procedural:room?size=32x24", "--causal", "--revise", "auto", "--out", "x"), "--revise auto: wanted"),
        (("train", "--seed", "-1", "--out", "x"), "--seed: wanted a number from 0"),
        (("train", "--seed", str(2**63), "--out", "x"), "--seed: wanted a number from 0"),
        (("train", "--scale-steps", "inf", "--out", "x"), "--scale-steps: wanted a finite number above 0"),
        (("poses", ".", "--frames", "20", "--out", "x"), "--frames: wanted a video"),
    ],
)
def test_bad_values_are_one_line_and_exit_2(arguments, named, capsys, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    assert run(*arguments) == 2
    lines = [line for line in capsys.readouterr().err.splitlines() if line.strip()]
    assert len(lines) == 1 and named in lines[0]
    assert not any(tmp_path.iterdir())


def test_lpips_weights_are_refused_where_nothing_is_rendered(tmp_path, capsys, monkeypatch):
    monkeypatch.setattr(train_command, "load_lpips_weights", lambda vgg, heads: object())
    assert run("train", "--recipe", "depth", "--lpips-vgg", "vgg.npz", "--out", str(tmp_path / "x")) == 2
    assert "--lpips-vgg: --recipe depth has no use for it" in capsys.readouterr().err
    assert not (tmp_path / "x").exists()


@pytest.mark.parametrize("command", ["demo", "eval", "eval --index", "render"])
def test_files_of_a_run_are_not_replaced_by_other_commands(command, tmp_path, capsys):
    out = tmp_path / "out"
    out.mkdir()
    for name in ("state.npz", "scene.ply", "metrics.json", "refined.ply"):
        (out / name).write_text("of a run")
    room = "procedural:room?frames=12&size=32x24"
    arguments = {"demo": (), "eval": (room,), "render": (str(tmp_path / "a.ply"), room)}.get(command)
    if command == "render":
        save_ply(tmp_path / "a.ply", scene_fixture.scene(0, n=5))
    if arguments is None:  # eval of scenes
        make_capture(tmp_path / "scenes" / "wall", num_frames=3)
        (tmp_path / "index.json").write_text(json.dumps({"wall": {"context": [0, 2], "target": [1]}}))
        arguments = (str(tmp_path / "scenes"), "--index", str(tmp_path / "index.json"))
    assert run(command.split()[0], *arguments, "--out", str(out)) == 2
    assert "wanted a folder without a run" in capsys.readouterr().err
    assert [file.read_text() for file in out.iterdir()] == 4 * ["of a run"]


def test_weights_are_refused_for_a_scene_that_is_decoded(tmp_path, capsys):
    (tmp_path / "scene.ply").write_text("ply")
    for scene in (tmp_path, tmp_path / "scene.ply"):
        assert run("export", str(scene), "--to", str(tmp_path / "x.splat"), "--weights", "other.npz") == 2
        assert "--weights: wanted a run" in capsys.readouterr().err


def test_another_system_is_named(monkeypatch, capsys):
    monkeypatch.setattr(sys, "platform", "win32")
    with pytest.raises(SystemExit) as ended:
        start()
    assert ended.value.code == 2 and "wanted Linux or macOS, got Windows" in capsys.readouterr().err


def test_inspect_prints_json(capsys):
    assert run("inspect", "procedural:orbit?frames=12&size=64x48", "--json") == 0
    facts = json.loads(capsys.readouterr().out)
    assert facts["num_frames"] == 12 and facts["near"] < facts["far"]


def test_inspect_prints_units_and_shows_that_it_works(capsys, monkeypatch):
    given = []
    monkeypatch.setattr(capture_summary, "summarize", lambda *options: given.append(options) or summarize(*options))
    assert run("inspect", "procedural:orbit?frames=12&size=64x48") == 0
    captured = capsys.readouterr()
    facts = {line.split()[0]: line for line in captured.out.splitlines()}
    for name in ("near", "far"):
        assert facts[name].endswith(" stream units (capture units times scene_scale)")
    assert facts["median_depth"].endswith(" capture units") and facts["num_depth_maps"].split()[1] == "12"
    assert "matching" in captured.err and "12/12" in captured.err
    ((_, _, advance),) = given  # without it the bar would stand still until all is done
    assert callable(advance)


@pytest.mark.parametrize(
    ("change", "field", "value"),
    [
        ("voxel_size=1", "voxel_size", 1.0),
        ("encoder_widths=[16, 32]", "encoder_widths", (16, 32)),
        ("scene_scale=2.5", "scene_scale", 2.5),
        ("vacc=append", "vacc", "append"),
        ("carving=false", "carving", False),
    ],
)
def test_set_takes_what_the_field_holds(change, field, value):
    changed = apply_changes(preset("tiny"), (change,))
    assert changed.get(field) == value and type(changed.get(field)) is type(value)
    hash(changed)


def test_two_values_of_one_field_are_refused():
    for twice in (("voxel_size=0.02", "memory.voxel_size=0.05"), ("voxel_size=0.02", "voxel_size=0.03")):
        with pytest.raises(InputError, match=r"wanted one value of memory\.voxel_size, got voxel_size=0\.02 and"):
            apply_changes(preset("tiny"), twice)
    with pytest.raises(InputError, match=r"one value of stream\.causal"):  # --causal beside --set
        apply_changes(preset("tiny"), causal_changes(("causal=false",), causal=True))
    assert apply_changes(preset("tiny"), ("causal=true", "stream.causal=true")).stream.causal


def test_a_folder_of_captures_that_is_none_is_refused(tmp_path, capsys):
    asked = ["experiment", "refinement", "--captures", str(tmp_path / "typo"), "--out", str(tmp_path / "out")]
    with pytest.raises(SystemExit) as stop:
        main(asked)
    assert stop.value.code == 2 and not (tmp_path / "out").exists()
    assert "--captures: wanted a folder of captures" in capsys.readouterr().err


def test_set_takes_null_where_a_field_may_be_empty():
    assert apply_changes(preset("small"), ("depth_range=null",)).network.depth_range is None
    with pytest.raises(InputError, match=r"--set voxel_size: wanted a value like 0\.\d+, got 'null'"):
        apply_changes(preset("tiny"), ("voxel_size=null",))


def assert_deltas_give_the_scene(out, *names):
    """The changes of every chunk, put together, against the final state decoded at once."""
    files = sorted((out / "deltas").iterdir())
    assert [path.name for path in files] == list(names)
    told = functools.reduce(apply_delta, map(load_delta, files), None)
    cache, header = load_state(out / "state.npz")
    exposure = np.exp(np.median(np.log(list(header["exposures"].values())), axis=0)).tolist()
    told_header = load_delta_header(files[-1])
    assert told_header.pop("exposure") == pytest.approx(exposure)
    assert told_header == {"frame": header["frame"], "views": header["done"]}
    model = StreamSplat(StreamConfig.from_dict(header["config"]))
    scene = jax.jit(model.decode)(load_params("tiny"), cache)
    assert 0 < (told.opacities > 0).sum() == (np.asarray(scene.opacities) > 0).sum()
    for field in dataclasses.fields(scene):
        np.testing.assert_allclose(getattr(told, field.name), getattr(scene, field.name), rtol=1e-5, atol=1e-5)


def test_run_stops_resumes_and_exports(tmp_path, capsys):
    out = tmp_path / "run"
    capture = str(make_capture(tmp_path / "capture", num_frames=12, size=(64, 48)))
    (out / "deltas").mkdir(parents=True)
    (out / "deltas" / "000003.npz").write_bytes(b"of a run that was stopped before its first save")
    assert run("run", capture, "--out", str(out), "--save-every", "1", "--deltas", "--quiet") == 0
    assert {"scene.ply", "state.npz", "metrics.json"} <= {p.name for p in out.iterdir()}
    assert_deltas_give_the_scene(out, "000004.npz", "000008.npz", "000012.npz")
    assert "--weights" not in (out / "report.html").read_text()  # commands take the shipped weights anyway
    metrics = json.loads((out / "metrics.json").read_text())
    assert metrics["cache"]["num_chunks"] == 3 and list(metrics["exposures"]) == [str(i) for i in range(12)]
    assert metrics["peak_memory_bytes"] >= metrics["step_memory_bytes"] > 0
    capsys.readouterr()
    assert run("export", str(out), "--to", str(tmp_path / "again.ply")) == 0
    # Rows of padding, which fill the arrays up to a power of two, are no Gaussians that were left out.
    counts = [int(word) for word in re.findall(r"\d+", capsys.readouterr().out.split("again.ply")[1])]
    assert sum(counts) == metrics["cache"]["decoded"]
    assert (tmp_path / "again.ply").read_bytes() == (out / "scene.ply").read_bytes()
    other = tmp_path / "other.npz"
    params, config = load_params("tiny"), preset("tiny")
    save_weights(other, jax.tree.map(lambda x: 0.5 * x, params), config, {})
    assert run("export", str(out), "--to", str(tmp_path / "wrong.ply"), "--weights", str(other)) == 2
    assert "other weights" in capsys.readouterr().err and not (tmp_path / "wrong.ply").exists()
    # A finished run is not streamed twice; deltas asked for only now begin with the whole scene.
    shutil.rmtree(out / "deltas")
    assert run("run", capture, "--out", str(out), "--deltas", "--quiet") == 0
    assert_deltas_give_the_scene(out, "000012.npz")
    # Without deltas it is left alone; going on without telling more leaves none that would not add up to the scene.
    assert run("run", capture, "--out", str(out), "--quiet") == 0
    assert_deltas_give_the_scene(out, "000012.npz")
    # Nothing of it is written or computed again, the figures of the run included.
    before = {path: (path.stat().st_mtime_ns, path.read_bytes()) for path in out.rglob("*.*")}
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr("ssplat_jax.runs.capture_run.finish_run", None)
        patch.setattr("ssplat_jax.streaming.session.Session.gaussians", None)
        capsys.readouterr()
        assert run("run", capture, "--out", str(out), "--quiet") == 0
    assert capsys.readouterr().out.startswith(f"{out} holds this run, finished: scene.ply (")
    assert {path: (path.stat().st_mtime_ns, path.read_bytes()) for path in out.rglob("*.*")} == before
    assert json.loads((out / "metrics.json").read_text())["compile_s"] > 0
    # A run that was stopped while it wrote its results writes them when it goes on.
    (out / "metrics.json").unlink()
    assert run("run", capture, "--out", str(out), "--quiet") == 0
    assert capsys.readouterr().out.startswith("wrote ") and (out / "metrics.json").exists()
    shutil.copy(out / "state.npz.previous", out / "state.npz")
    assert run("run", capture, "--out", str(out), "--quiet") == 0
    assert not any((out / "deltas").glob("*.npz"))
    # Another configuration is refused.
    assert json.loads((out / "metrics.json").read_text())["cache"]["num_chunks"] == 3
    for changes, difference in (
        (("--set", "voxel_size=0.1"), "differs in its config (voxel_size: 0.03 there, 0.1 now)"),
        (("--stride", "2"), "differs in its frames (12 there, 6 now"),
        (("--size", "32x24"), "differs in its size ([64, 48] there, [32, 24] now)"),
        (("--quality", "fast"), "differs in its size ([64, 48] there, [32, 24] now)"),
        (("--weights", str(other)), "differs in its weights"),
    ):
        capsys.readouterr()
        assert run("run", capture, "--out", str(out), *changes, "--quiet") == 2
        (line,) = capsys.readouterr().err.splitlines()
        assert difference in line and "--overwrite" in line
    images = tmp_path / "capture" / "images"
    kept = (images / "5.png").read_bytes()
    (images / "5.png").write_bytes((images / "4.png").read_bytes())
    assert run("run", capture, "--out", str(out), "--quiet") == 2
    assert "differs in its images" in capsys.readouterr().err
    (images / "5.png").write_bytes(kept)
    edit("transform_matrix", np.diag([1.0, 1.0, 1.0, 1.0]).tolist())(tmp_path / "capture")  # a corrected pose
    assert run("run", capture, "--out", str(out), "--quiet") == 2
    assert "differs in its poses" in capsys.readouterr().err


@pytest.mark.slow
def test_a_run_continues_with_a_larger_capacity(tmp_path):
    out, capture = tmp_path / "run", str(make_capture(tmp_path / "capture", num_frames=8, size=(64, 48)))
    assert run("run", capture, "--out", str(out), "--set", "overflow=error", "--quiet") == 0
    scene = (out / "scene.ply").read_bytes()
    more = ("--set", "capacity=65536", "overflow=grow")
    assert run("run", capture, "--out", str(out), *more, "--quiet") == 0
    assert load_state(out / "state.npz")[0].num_voxels > 0 and (out / "scene.ply").read_bytes() == scene


NUM_FADED = 7


def some_fade(*given, **more):
    """`refine_on_capture` by which some Gaussians disappear, as more steps let some."""
    refined, report = refine_on_capture(*given, **more)
    is_present = np.asarray(refined.opacities) > 0
    is_kept = ~(is_present & (np.cumsum(is_present) <= NUM_FADED))
    return mask_gaussians(refined, jnp.asarray(is_kept)), report


def test_eval_writes_every_promised_field(tmp_path, monkeypatch):
    monkeypatch.setattr(cost, "NUM_REPEATS", 1)  # how often it times is not what is tested
    monkeypatch.setattr(evaluate, "refine_on_capture", some_fade)
    out = tmp_path / "eval"
    capture = make_capture(tmp_path / "capture", num_frames=12, size=(128, 96))
    arguments = ("eval", str(capture), "--context", "8", "--quality", "fast", "--refine", "3", "--quiet")
    assert run(*arguments, "--out", str(out)) == 0
    metrics = json.loads((out / "metrics.json").read_text())
    promised = {
        "literal", "shown", "psnr_over_black", "psnr_one_exposure", "per_view", "context_views", "target_views",
        "chunk_ms", "step_ms", "render_ms", "compile_s", "step_memory_bytes", "peak_memory_bytes", "cache",
        "num_gaussians", "config_hash", "baselines",
    }  # fmt: skip
    assert promised <= metrics.keys()
    assert metrics["peak_memory_bytes"] >= metrics["step_memory_bytes"] > 0
    assert metrics["literal"].keys() == metrics["shown"].keys() == {"psnr", "ssim", "lpips"}
    assert {"voxels", "pivots", "capacity", "overflow", "accepted_fraction"} <= metrics["cache"].keys()
    assert {"nearest_view_psnr", "mean_color_psnr"} <= metrics["baselines"].keys()
    assert metrics["context_views"] == 8 and metrics["target_views"] == len(metrics["per_view"]) == 1
    per_token = preset("tiny").head.gaussians_per_token
    decoded, refined = metrics["cache"]["decoded"], metrics["num_gaussians"]
    assert per_token * metrics["cache"]["pivots"] >= decoded > 0
    assert refined == decoded + metrics["refinement"]["new_gaussians"] - NUM_FADED
    assert hashlib.sha256((out / "split.json").read_bytes()).hexdigest() == metrics["split_sha256"]
    # Streamed at half the size, scored at the whole.
    assert (metrics["streamed_size"], metrics["size"]) == ([64, 48], [128, 96])
    with Image.open(out / "view_00004.png") as picture:
        assert picture.size == (3 * 128, 96)
    refinement = metrics["refinement"]
    assert refinement["steps"] == 3 and refinement["skipped_steps"] == 0
    assert all(0 < abs(metrics[name]["psnr"] - refinement["before"][name]["psnr"]) < 3 for name in ("literal", "shown"))


def test_negative_refinement_steps_are_bad_usage(tmp_path, capsys):
    capture = make_capture(tmp_path / "capture", num_frames=12, size=(128, 96))
    assert run("eval", str(capture), "--context", "8", "--out", str(tmp_path / "out"), "--refine", "-1") == 2
    assert "--refine: wanted a number of steps of at least 0, got -1" in capsys.readouterr().err
    assert run("run", str(capture), "--out", str(tmp_path / "out"), "--refine", "-1") == 2
    assert "--refine: wanted a number of steps of at least 0, got -1" in capsys.readouterr().err
    assert not (tmp_path / "out").exists()


@pytest.mark.slow
def test_run_refine_equals_run_then_refine(tmp_path, capsys):
    capture, size = "procedural:room?frames=4", ("--size", "64x48")
    one, two = (tmp_path / name for name in ("one", "two"))
    assert run("run", capture, "--out", str(one), *size, "--refine", "2", "--quiet") == 0
    assert "refined.ply: 2 steps" in capsys.readouterr().out
    assert run("run", capture, "--out", str(two), *size, "--quiet") == 0
    assert run("refine", str(two), capture, "--steps", "2", "--quiet") == 0
    for name in ("scene.ply", "refined.ply"):
        assert (one / name).read_bytes() == (two / name).read_bytes()


@pytest.mark.slow  # compiles a network of 62 million parameters
@pytest.mark.parametrize("name", ["small", "paper"])
def test_imported_weights_stream_a_capture(name, tmp_path, capsys):
    tensors = {
        t.name: named_tensor(t.name, t.shape) for t in published_tensors(preset("small")).values() if t is not None
    }
    np.savez(tmp_path / "upstream.npz", **tensors)
    checkpoint, file = tmp_path / "upstream.npz", tmp_path / f"{name}.npz"
    assert run("import-weights", str(checkpoint), "--preset", name, "--out", str(file)) == 0
    assert "701 tensors (0 not used); fresh: HPDA and CGFI" in capsys.readouterr().out
    params, config = load_weights(file)
    assert config == as_published(preset(name))
    assert params["decoder"]["gaussian_head_2"]["kernel"].dtype == np.float32
    theirs = tensors["encoder.gaussian_head.2.weight"]
    np.testing.assert_array_equal(params["decoder"]["gaussian_head_2"]["kernel"], theirs.T)
    capture, out = make_capture(tmp_path / "capture"), tmp_path / "out"
    weights = ("--weights", str(file), "--set", "min_confidence=0.0", "capacity=32768")
    assert run("run", str(capture), "--out", str(out), *weights, "--quiet") == 0
    assert load_ply(out / "scene.ply").num_gaussians > 0


@pytest.mark.parametrize(
    ("name", "kind"),
    [("a.jpg", "images"), ("images/a.PNG", "images"), ("scan.TIF", "images"), ("my clip.mp4", "a video")],
)
def test_images_without_poses_are_told_how_to_get_them(name, kind, tmp_path, capsys, monkeypatch):
    folder = tmp_path / "my trip"
    file = folder / name
    file.parent.mkdir(parents=True)
    file.write_bytes(b"")
    for path in [folder] if kind == "images" else [folder, file]:
        for command in (("inspect",), ("run", "--out", "x"), ("eval", "--out", "x")):
            assert run(command[0], str(path), *command[1:]) == 2
            message = capsys.readouterr().err
            assert f"but {kind} without camera poses" in message and message.count("\n") == 1
        words = re.search(r"ssplat (poses .+ --out .+) \(", message)
        assert words is not None
        # The command that is named is one, spaces or not: it gets as far as the file, which is no picture.
        monkeypatch.chdir(tmp_path)
        assert run(*shlex.split(words[1]), "--quiet") == 2
        source = file if kind == "a video" else path
        assert str(source) in capsys.readouterr().err and not any(tmp_path.glob("*_capture"))


def test_a_folder_with_only_a_scene_is_exported(tmp_path, capsys):
    scene = Gaussians.from_rgb(
        means=jnp.zeros((3, 3)),
        quats=jnp.ones((3, 4)),
        scales=jnp.ones((3, 3)),
        opacities=jnp.array([0.5, 0.0, 0.5]),
        colors=jnp.full((3, 3), 0.5),
    )
    save_ply(RunFolder(tmp_path).scene, scene)  # as `ssplat demo` leaves it: no saved state
    assert run("export", str(tmp_path), "--to", str(tmp_path / "scene.spz")) == 0
    assert "2 Gaussians" in capsys.readouterr().out and (tmp_path / "scene.spz").stat().st_size > 0


def test_an_interrupt_says_so_and_exits_with_130(capsys):
    def interrupted():
        raise KeyboardInterrupt

    assert guarded(interrupted) == 130
    assert capsys.readouterr().err == "ssplat: interrupted\n"
