"""`ssplat eval`: one capture, or the scenes of an index file, each in a folder of its own; and `ssplat demo`."""

import time
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np

from ssplat_jax.config import preset
from ssplat_jax.core.console import Reporter
from ssplat_jax.core.cpu_backend import make_room
from ssplat_jax.core.errors import InputError, echo, is_out_of_memory, refusal
from ssplat_jax.core.gaussians import Gaussians
from ssplat_jax.data.capture import Capture
from ssplat_jax.data.open_capture import PROCEDURAL_SIZE, is_capture, open_capture, without_tilde
from ssplat_jax.data.posed_image import split_options, with_options
from ssplat_jax.data.split import Index, Split, choose_split, index_to_json, read_index, split_of_scene
from ssplat_jax.evaluation.cost import OOM
from ssplat_jax.evaluation.metrics import installed_lpips
from ssplat_jax.evaluation.pictures import save_image
from ssplat_jax.evaluation.scoring import ScoredView, evaluate, mean_scores, score_view
from ssplat_jax.model.streamsplat import StreamSplat
from ssplat_jax.refinement import online_refinement
from ssplat_jax.runs.run_results import report_eval, save_scene
from ssplat_jax.runs.stream_commands import Eval
from ssplat_jax.storage.files import write_json
from ssplat_jax.storage.run_folder import RunFolder
from ssplat_jax.storage.weights import load_params
from ssplat_jax.streaming.session import Exposures, Session, feed_chunks

SCORES = ("literal", "shown")  # scores of a scene that are averaged over scenes


def evaluate_run(model: StreamSplat, params: dict, options: Eval, reporter: Reporter) -> dict[str, Any]:
    """Scores a capture, or every scene of an index file below a folder.

    Args:
        model: the model to run.
        params: the model's parameters.
        options: what is scored: a capture, or with an index also a folder that holds a capture for each scene; and
            the folder of the results, in which each of many scenes has one.
        reporter: shows progress and warnings.

    Returns:
        The metrics of the capture (`evaluate`), or of the scenes (`scene_metrics`), as written to metrics.json.

    Raises:
        InputError: a capture or the index is unusable, options contradict each other, the folder holds a run, or poses
            of a causal stream are to be adjusted.
        StorageError: the folder cannot be written.
    """

    def evaluated(capture: Capture, split: Split, out: Path, scene: str | None = None) -> dict[str, Any]:
        """The metrics of one capture, in a session of its own; writes its report, too."""
        metrics = evaluate(
            Session(model, params, refine=online_refinement(model)),
            capture,
            split,
            out,
            reporter,
            streamed=capture.scaled(options.scale),
            lpips_weights=installed_lpips(),
            refine_steps=options.refine_steps,
            adjust_poses=options.adjust_poses,
            scene=scene,
        )
        report_eval(RunFolder(out), metrics)
        return metrics

    path, size, out = options.path, options.image_size, options.out
    if options.scene is not None and options.index is None:
        raise InputError("--scene: wanted --index beside it, whose scene it names; got none.")
    folder = without_tilde(split_options(path)[0])
    are_scenes = options.scene is None and folder.is_dir() and not is_capture(folder)
    if options.index is not None:
        clash = [name for name in ("stride", "context", "targets") if getattr(options, name) is not None]
        if clash := [*clash, *["protocol"] * (options.protocol != Eval.protocol)]:
            raise refusal("--index", wanted="no frames chosen otherwise", got=f"--{clash[0]} too", fix="leave one out")
        index, notes = read_index(options.index)
    elif are_scenes and any(map(is_capture, folder.iterdir())):
        index, notes = index_of_folder(options)
    else:
        capture = open_capture(path, size=size)
        return evaluated(capture, _split(capture, options), out)
    reporter.warn_all(*notes)
    if not are_scenes:
        capture = open_capture(path, size=size)
        scene = options.scene or capture.name
        return evaluated(capture, split_of_scene(index, scene, len(capture)), out, scene)
    captures = _open_scenes(path, index, size)
    for results in (out, *(out / scene for scene in captures)):
        RunFolder(results).check_no_run()
    for capture in captures.values():
        capture.check_output_folder(out)
    splits = {scene: split_of_scene(index, scene, len(capture)) for scene, capture in captures.items()}
    scored = {}
    for scene, capture in captures.items():
        make_room()  # programs of many scenes would be too many for one process
        reporter.say(scene)
        try:
            scored[scene] = evaluated(capture, splits[scene], out / scene, scene)
        except RuntimeError as error:
            if not is_out_of_memory(error):
                raise
            scored[scene] = {"peak_memory_bytes": OOM}
            reporter.warn(f"{scene}: out of memory; so there are no means over scenes")
    metrics = scene_metrics(scored) | {"left_out": [scene for scene, split in index.items() if split is None]}
    write_json(RunFolder(out).index, index_to_json(index))
    write_json(RunFolder(out).metrics, metrics)
    return metrics


def _split(capture: Capture, options: Eval) -> Split:
    """The frames of a capture by the protocol."""
    return choose_split(options.protocol, len(capture), options.stride, options.context, options.targets)


def index_of_folder(options: Eval) -> tuple[Index, tuple[str, ...]]:
    """The frames of every capture in a folder by the protocol, None for one that is too short, and notes that say so.

    Raises:
        InputError: a capture is unusable.
    """
    root, written = split_options(options.path)
    index: Index = {}
    notes = []
    for scene in sorted(folder.name for folder in without_tilde(root).iterdir() if is_capture(folder)):
        capture = open_capture(with_options(f"{root}/{scene}", **written), size=options.image_size)
        try:
            index[scene] = _split(capture, options)
        except InputError as error:
            index[scene] = None
            notes.append(f"{scene}: left out ({error})")
    return index, tuple(notes)


def _open_scenes(path: str, index: Index, size: tuple[int, int] | None) -> dict[str, Capture]:
    """The captures of all scenes of an index, in the folder `path`; all are opened before the first is streamed."""
    root, written = split_options(path)
    folder = without_tilde(root)
    if unsafe := [scene for scene in index if not (folder / scene).resolve().is_relative_to(folder.resolve())]:
        got, fix = echo(unsafe[0]), "name scenes after folders"
        raise refusal("--index", wanted=f"scenes below {folder}", got=got, fix=fix)
    if not any((folder / scene).exists() for scene in index):
        got, fix = "no folder of that name", "give the folder that holds one folder per scene"
        raise refusal(str(folder), wanted=f"a capture, or scenes such as {next(iter(index))}", got=got, fix=fix)
    used = [scene for scene, split in index.items() if split is not None]
    if not used:
        fix = "choose a smaller --context, or frames for one in --index"
        raise refusal(str(folder), wanted="frames of at least one scene", got="none", fix=fix)
    return {scene: open_capture(with_options(str(folder / scene), **written), size=size) for scene in used}


def scene_metrics(scored: Mapping[str, Mapping[str, Any]]) -> dict[str, Any]:
    """Means over scenes.

    Args:
        scored: the metrics of `evaluate` by scene, which are means over the views of the scene; of one that did not fit
            into memory, `peak_memory_bytes` alone, which is `OOM`.

    Returns:
        `scenes`, the scores, number of targets and memory of each; `over_scenes`, the mean over views, then scenes; and
        `over_views`, the mean over the views of all scenes; `lpips` is None where a scene has none. And the largest
        `peak_memory_bytes` of a scene. With a scene that is `OOM` there are no means.
    """
    names = (*SCORES, "target_views", "peak_memory_bytes")
    rows = {scene: {name: m.get(name) for name in names} for scene, m in scored.items()}
    if OOM in (row["peak_memory_bytes"] for row in rows.values()):
        return {"scenes": rows, "over_scenes": None, "over_views": None, "peak_memory_bytes": OOM}
    weights = np.array([row["target_views"] for row in rows.values()], np.float64)
    blocks = [{name: row[name] for name in SCORES} for row in rows.values()]
    return {
        "scenes": rows,
        "over_scenes": _weighted_mean(blocks, np.ones(len(blocks))),
        "over_views": _weighted_mean(blocks, weights),
        "peak_memory_bytes": max(m["peak_memory_bytes"] or 0 for m in scored.values()) or None,
    }


def _weighted_mean(values: list[Any], weights: np.ndarray) -> Any:
    """The weighted mean of equal trees of numbers; None where one is None."""
    if isinstance(values[0], dict):
        return {name: _weighted_mean([value[name] for value in values], weights) for name in values[0]}
    return None if None in values else round(float(np.average(values, weights=weights)), 4)


# -- demo --------------------------------------------------------------------------------------------------------------

SHOWN_PIVOTS = 1 << 16
"""Pivots that are decoded after every stage, as many as after the last: every number is a program to compile."""

STAGES = (4, 8, 16, 32, 64)  # numbers of streamed views after which the scene is decoded and scored


def run_demo(scene: str, out: Path, reporter: Reporter) -> dict:
    """Streams `procedural:scene` and scores the same targets after every stage.

    Args:
        scene: name of the procedural scene.
        out: folder of the scene, the pictures and the metrics.
        reporter: shows progress and the table.

    Returns:
        The metrics as written.

    Raises:
        InputError: `out` holds a run.
        StorageError: `out` cannot be written; who calls it has locked it, see `lock_folder`.
    """
    folder, since = RunFolder(out), time.perf_counter()
    folder.check_no_run()
    folder.clear_refinement()  # of an earlier command
    model, params = StreamSplat(preset("tiny")), load_params("tiny")
    session = Session(model, params)
    session.least_decoded = SHOWN_PIVOTS
    session.compile_ahead(*PROCEDURAL_SIZE, STAGES[-1])
    capture = open_capture(f"procedural:{scene}")  # 64 context views and the 9 interleaved targets between them
    split = choose_split("interleaved", len(capture), 1, STAGES[-1])
    stream_frame = capture.stream_frame(model.config, split.context)
    order = capture.stream_order(model.config, split.context, stream_frame)
    exposures: Exposures = {}
    stages: list[tuple[Gaussians, Exposures, int]] = []
    with reporter.progress("streaming", STAGES[-1]) as advance:
        for fed in feed_chunks(session, capture, order, stream_frame):
            exposures = exposures | fed.exposures
            advance(len(exposures))
            if len(exposures) in STAGES:
                stages.append((session.gaussians(), exposures, int(session.cache_facts()["decoded"])))
    save_scene(folder.scene, stages[-1][0], stream_frame, exposures)
    reporter.say(f"{folder.scene} is written; pictures and figures follow")
    scored: list[list[ScoredView]] = []
    with reporter.progress("scoring", len(STAGES)) as advance:
        for gaussians, known, _ in reversed(stages):  # the program for the fullest scene serves all
            scored.insert(0, [score_view(gaussians, capture, i, stream_frame, known) for i in split.targets])
            advance(len(scored))
    rows = []
    for views, (_, known, num_gaussians) in zip(scored, stages, strict=True):
        scores, row = mean_scores([view.score for view in views]), {"views": len(known)}
        for kind in ("shown", "literal"):
            row |= {f"{kind}_psnr": round(scores[kind]["psnr"], 2), f"{kind}_ssim": round(scores[kind]["ssim"], 3)}
        coverage = round(float(np.mean([view.score.coverage for view in views])), 3)
        rows.append(row | {"coverage": coverage, "num_gaussians": num_gaussians})
    strip = [views[len(views) // 2].color for views in scored]
    for view in scored[-1]:
        view.save(folder.target(view.score.frame), stream_frame.depth_range)
    strip.append(scored[-1][len(split.targets) // 2].target)
    save_image(out / "views_4_8_16_32_64_target.png", np.concatenate(strip, axis=1))
    metrics = {
        "scene": scene,
        "size": [capture.width, capture.height],
        "stages": rows,
        "cache": session.cache_facts(),
        "compile_s": round(session.compile_seconds, 2),
        "seconds": round(time.perf_counter() - since, 1),
        "config_hash": model.config.hash,
        "stream_frame": stream_frame.to_dict(),
    }
    write_json(folder.metrics, metrics)
    header = ("views", "shown dB", "SSIM", "literal dB", "SSIM", "covered", "Gaussians")
    reporter.table(f"{scene}: quality of unseen views", header, [tuple(row.values()) for row in rows])
    return metrics
