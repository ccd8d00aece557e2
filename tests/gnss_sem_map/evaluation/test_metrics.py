"""Every figure agrees with scikit-learn, with the independent scorer, and with cases counted by hand."""

from __future__ import annotations

import importlib.util
import json
from dataclasses import asdict, replace
from pathlib import Path

import numpy as np
import pytest
from sklearn.metrics import jaccard_score, precision_score

from factor_graphs.geodesy import LocalFrame
from factor_graphs.trajectory import Trajectory
from factor_graphs.tum import write_tum
from gnss_sem_map.config import Settings
from gnss_sem_map.errors import DataError
from gnss_sem_map.evaluation import metrics
from gnss_sem_map.evaluation.metrics import Tables, confusion, dynamic, dynamic_counts, semantics
from gnss_sem_map.evaluation.score_run import score_run, score_trajectory
from gnss_sem_map.files import ownership
from gnss_sem_map.labels.label_set import open_label_set

URBAN = open_label_set()
TABLES = Tables.of(URBAN)
PREDICTED = np.array([0, 40, 48, 10, 50, 70, 99], np.uint32)
TRUE = np.array([0, 1, 10, 11, 13, 15, 16, 18, 20, 30, 40, 44, 48, 49, 50, 51, 52, 60, 70, 71, 72, 80, 81, 99,
                 252, 253, 254, 255, 256, 257, 258, 259], np.uint32)  # fmt: skip
IDS = {40: [40, 60], 48: [48], 10: [10, 13, 15, 18, 20, 252, 256, 257, 258, 259], 50: [50], 70: [70, 71]}


def random_labels(seed: int, n: int = 20_000) -> tuple[np.ndarray, np.ndarray]:
    rng = np.random.default_rng(seed)
    instances = rng.integers(0, 1 << 16, (2, n)).astype(np.uint32) << 16
    return rng.choice(PREDICTED, n) | instances[0], rng.choice(TRUE, n) | instances[1]


def ids(*values: int) -> np.ndarray:
    return np.array(values, np.uint32)


def test_accuracy_and_iou_are_scikit_learn_s_precision_and_jaccard() -> None:
    prediction, truth = random_labels(0)
    of_class = {raw: i for i, group in enumerate(IDS.values()) for raw in group}
    true = np.array([of_class.get(int(t) & 0xFFFF, -1) for t in truth])
    guess = np.array([of_class.get(int(p) & 0xFFFF, 5) for p in prediction])
    counted = (true >= 0) & (guess < 5)
    found = semantics(confusion(prediction, truth, TABLES, "here"), URBAN)
    labels = list(range(5))
    accuracy = precision_score(true[counted], guess[counted], labels=labels, average=None)
    iou = jaccard_score(true[counted], guess[counted], labels=labels, average=None)
    for i, name in enumerate(URBAN.names):
        assert found["classes"][name] == {
            "accuracy": pytest.approx(accuracy[i]),
            "iou": pytest.approx(iou[i]),
        }
    assert found["mean_iou"] == pytest.approx(iou.mean())
    assert found["coverage"] == pytest.approx((guess[true >= 0] < 5).mean())


def test_a_class_that_no_point_is_labelled_of_is_left_out_of_the_mean_and_a_miss_of_the_strict_one() -> None:
    prediction, truth = ids(40, 40, 10, 0, 0), ids(40, 40, 10, 48, 48)  # all of the sidewalk is unlabelled
    found = semantics(confusion(prediction, truth, TABLES, "here"), URBAN)
    assert (found["mean_accuracy"], found["mean_iou"]) == (1.0, 1.0)
    assert found["strict"] == {"mean_accuracy": pytest.approx(2 / 3), "mean_iou": pytest.approx(2 / 3)}
    half = semantics(confusion(ids(40, 40, 10, 48, 0), truth, TABLES, "here"), URBAN)
    assert half["strict"] == {"mean_accuracy": half["mean_accuracy"], "mean_iou": pytest.approx(2.5 / 3)}


def test_figures_agree_with_the_independent_scorer_to_the_last_digit(real_data: Path) -> None:
    spec = importlib.util.spec_from_file_location("score", real_data.parent / "score.py")
    assert spec is not None
    assert spec.loader is not None
    score = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(score)
    folder = real_data / "semantic_kitti/sequences/08/labels"
    counts = np.zeros((6, 7), np.int64)
    for path in sorted(folder.glob("*.label")):
        prediction = np.fromfile(real_data / "single_frame/08" / path.name, "<u4")
        counts += confusion(prediction, np.fromfile(path, "<u4"), TABLES, path.name)
    theirs = score.figures(score.score_pair(real_data / "single_frame/08", folder))
    ours = semantics(counts, URBAN)
    assert counts[:5, [0, 1, 2, 3, 4, 6]].tolist() == theirs["counts"]
    assert ours["mean_iou"] == theirs["observed"]["mean_iou"]
    assert ours["mean_accuracy"] == theirs["observed"]["mean_accuracy"]
    assert ours["strict"] == {key: theirs["strict"][key] for key in ("mean_accuracy", "mean_iou")}
    assert ours["coverage"] == theirs["coverage"]
    for name in URBAN.names:
        assert ours["classes"][name] == {
            "accuracy": theirs["observed"]["accuracy"][name], "iou": theirs["observed"]["iou"][name]
        }  # fmt: skip


def test_a_case_counted_by_hand() -> None:
    """Road 3 right, 1 called sidewalk, 1 unlabelled; sidewalk 1 right. Parking: 1 called road, 1 other, 1 unlabelled.

    What has no truth, or is an outlier, is not counted.
    """
    counts = confusion(
        ids(40, 40, 40, 48, 0, 48, 40, 99, 0, 40, 99),
        ids(40, 60, 40, 40, 40, 48, 44, 44, 44, 0, 1),
        TABLES,
        "here",
    )
    found = semantics(counts, URBAN)
    assert found["classes"]["road"] == {"accuracy": 1.0, "iou": 3 / 4}
    assert found["classes"]["sidewalk"] == {"accuracy": 1 / 2, "iou": 1 / 2}
    assert found["classes"]["vehicle"] is None
    assert found["mean_iou"] == (3 / 4 + 1 / 2) / 2
    assert found["strict"]["mean_iou"] == (3 / 5 + 1 / 2) / 2
    assert (found["coverage"], found["points"]) == (5 / 6, 6)
    assert (found["open"], found["wrong"], found["answered"]) == ((3 / 6 + 1 / 2) / 2, 2 / 6, 7 / 9)
    assert found["other"] == {"accuracy": 1.0, "iou": 1 / 3}


def test_other_where_a_class_is_true_is_a_miss_like_no_label() -> None:
    """Its own accuracy and IoU excepted, and that it is an answer."""
    truth = ids(40, 40, 48, 72)
    said, silent = (
        semantics(confusion(ids(40, answer, 48, 40), truth, TABLES, "here"), URBAN) for answer in (99, 0)
    )
    assert (said.pop("answered"), silent.pop("answered")) == (1.0, 3 / 4)
    assert said == silent
    assert said["other"] == {"accuracy": 0.0, "iou": 0.0}
    assert said["coverage"] == 2 / 3
    assert semantics(confusion(ids(40), ids(40), TABLES, "here"), URBAN)["other"] is None


def test_a_class_that_is_never_predicted_counts_as_zero() -> None:
    found = semantics(confusion(ids(40, 40), ids(40, 48), TABLES, "here"), URBAN)
    assert found["classes"]["sidewalk"] == {"accuracy": 0.0, "iou": 0.0}
    assert found["mean_iou"] == 1 / 4


def test_nothing_predicted_and_nothing_true_are_no_division_by_zero() -> None:
    nothing = semantics(confusion(ids(0, 0), ids(40, 48), TABLES, "here"), URBAN)
    assert (nothing["mean_iou"], nothing["strict"]["mean_iou"], nothing["coverage"]) == (None, 0.0, 0.0)
    empty = semantics(confusion(ids(), ids(), TABLES, "here"), URBAN)
    assert (empty["mean_iou"], empty["coverage"]) == (None, None)
    assert (nothing["open"], nothing["wrong"], nothing["answered"]) == (0.0, None, 0.0)
    assert (empty["open"], empty["wrong"], empty["answered"], empty["other"]) == (None, None, None, None)
    json.dumps([nothing, empty], allow_nan=False)


def test_counts_add_over_scans() -> None:
    a, b = random_labels(1), random_labels(2)
    both = np.concatenate([a[0], b[0]]), np.concatenate([a[1], b[1]])
    np.testing.assert_array_equal(
        confusion(*a, TABLES, "a") + confusion(*b, TABLES, "b"), confusion(*both, TABLES, "both")
    )


@pytest.mark.parametrize(
    ("prediction", "truth", "says"),
    [
        (ids(72), ids(40), r"found ids \[72\], expected 0 or one of \[40, 48, 10, 50, 70, 99\]"),
        (ids(99, 16, 16 + (7 << 16)), ids(0, 0, 40), r"found ids \[16\]"),
        (ids(40, 40), ids(40), "found 2 labels for 1 points"),
    ],
)
def test_labels_that_cannot_be_scored_are_refused(
    prediction: np.ndarray, truth: np.ndarray, says: str
) -> None:
    with pytest.raises(DataError, match=says):
        confusion(prediction, truth, TABLES, "here")


def test_removal_is_scored_on_moving_vehicles_and_everything_static() -> None:
    """Moving: 3 of 4 removed. Parked: 1 of 2 kept. Other static: 3 of 3 kept. A walker, noise and void do not count."""
    truth = ids(252, 258, 252, 259, 10, 10, 40, 50, 72, 254, 1, 0)
    removed = ids(1, 1, 1, 0, 0, 1, 0, 0, 0, 1, 1, 1)
    found = dynamic(dynamic_counts(removed, truth, TABLES, "here"))
    assert (found["DA"], found["SA"], found["SA_vehicle"]) == (3 / 4, 4 / 5, 1 / 2)
    assert found["AA"] == pytest.approx((3 / 4 * 4 / 5) ** 0.5)
    assert dynamic(np.zeros((3, 2), np.int64))["AA"] is None


def test_a_class_set_without_vehicles_has_no_moving_ones() -> None:
    names = tuple(name for name in URBAN.names if name != "vehicle")
    kept = {source: name for source, name in URBAN.sources["semantic_kitti"].items() if name in names}
    still = replace(
        URBAN,
        names=names,
        given_roles=None,
        semantic_kitti_ids=ids(40, 48, 50, 70),
        sources={"semantic_kitti": kept},
    )
    found = dynamic(dynamic_counts(ids(1, 1, 0), ids(252, 10, 40), Tables.of(still), "here"))
    assert (found["DA"], found["SA"], found["SA_vehicle"], found["moving_points"]) == (None, 1 / 2, None, 0)


def write_scored_run(folder: Path) -> None:
    """A run of one scan of four points, its truth, and a selection of points."""
    files = {
        "run.json": b"{}", "metrics.json": b"{}", "map/map.json": b"{}",
        "config.yaml": Settings().to_yaml().encode(),
        "labels/0.label": ids(40, 48, 0, 0), "labels_raw/0.label": ids(40, 48, 0, 0),
        "removed/0.label": ids(0, 0, 1, 0), "confidence/0.bin": np.ones(4, "<f2"), "looks/0.bin": np.ones(4, np.uint8),
        "truth/0.label": ids(40, 40, 252, 252), "some/0.label": ids(40, 0, 10, 0),
    }  # fmt: skip
    for name, content in files.items():
        (folder / name).parent.mkdir(exist_ok=True)
        (folder / name).write_bytes(bytes(content))
    ownership.write_list(folder)


def test_restricted_to_some_points_every_figure_is_of_these_alone(tmp_path: Path) -> None:
    write_scored_run(tmp_path)
    everything = score_run(str(tmp_path), str(tmp_path / "truth"))
    assert (everything["semantics"]["refined"]["mean_iou"], everything["dynamic"]["DA"]) == (1 / 2, 1 / 2)
    found = score_run(tmp_path, tmp_path / "truth", restrict_to=tmp_path / "some")
    assert (found["semantics"]["refined"]["mean_iou"], found["dynamic"]["DA"]) == (1.0, 1.0)
    assert found["dynamic"]["moving_points"] == 1


def open_figures(guess: np.ndarray, true: np.ndarray) -> dict[str, float]:
    """By the definitions, point by point: classes 0 to 4, 5 `other`; `guess` -1 unlabelled, `true` -1 not known."""
    guess, true = guess[true >= 0], true[true >= 0]
    called, known = (guess >= 0) & (guess < 5), true < 5
    strict, wide = (
        np.mean([
            np.sum((guess == c) & (true == c)) / np.sum(((guess == c) & counted) | (true == c)) for c in range(5)
        ])
        for counted in (known, np.ones_like(known))
    )  # fmt: skip
    return {
        "strict": strict, "open": wide, "coverage": called[known].mean(), "answered": (guess >= 0).mean(),
        "wrong": (guess != true)[called].mean(), "accuracy of other": (true[guess == 5] == 5).mean(),
        "IoU of other": np.sum((guess == 5) & (true == 5)) / np.sum((guess == 5) | (true == 5)),
    }  # fmt: skip


def calibration_error(sure: np.ndarray, right: np.ndarray) -> float:
    """Over bins of one fifteenth."""
    bins = np.minimum(np.floor(sure * 15), 14)
    gaps = [
        abs(np.mean(right[bins == b]) - np.mean(sure[bins == b])) * np.mean(bins == b)
        for b in np.unique(bins)
    ]
    return float(np.sum(gaps))


def test_a_run_is_scored_on_all_truth_and_apart_on_what_the_images_labelled(tmp_path: Path) -> None:
    """Scans of random labels; every figure is that of the definitions on all of their points."""
    write_scored_run(tmp_path)
    rng, of_class = (
        np.random.default_rng(5),
        {raw: i for i, group in enumerate(IDS.values()) for raw in group},
    )
    points = []
    for name in ("0", "1"):
        prediction, truth = random_labels(int(name))
        raw = np.where(rng.random(len(truth)) < 0.4, rng.choice(PREDICTED[:-1], len(truth)), 0).astype(
            np.uint32
        )
        sure = rng.random(len(truth)).astype("<f2")
        for file, content in {
            "labels/0.label": prediction, "labels_raw/0.label": raw, "truth/0.label": truth, "confidence/0.bin": sure,
            "removed/0.label": np.zeros_like(raw), "looks/0.bin": np.ones(len(truth), np.uint8),
        }.items():  # fmt: skip
            content.tofile(tmp_path / file.replace("0.", f"{name}."))
        true = [-1 if t & 0xFFFF < 2 else of_class.get(int(t) & 0xFFFF, 5) for t in truth]
        guess = [{0: -1, 99: 5}.get(int(p) & 0xFFFF, of_class.get(int(p) & 0xFFFF)) for p in prediction]
        points.append((true, guess, raw != 0, sure.astype(float)))
    true, guess, seen, sure = (np.concatenate(column) for column in zip(*points, strict=True))
    found = score_run(tmp_path, tmp_path / "truth")
    refined, expected = found["semantics"]["refined"], {}
    for part, which in ((refined, seen | True), (refined["seen"], seen), (refined["unseen"], ~seen)):
        figures = {name: part[name] for name in ("open", "wrong", "answered", "coverage")} | {
            "strict": part["strict"]["mean_iou"],
            "accuracy of other": part["other"]["accuracy"],
            "IoU of other": part["other"]["iou"],
        }
        assert figures == pytest.approx(open_figures(guess[which], true[which]), abs=1e-12)
    called = (guess >= 0) & (guess < 5)
    for name, which in (("ece", true < 5), ("ece_open", seen | True)):
        for of, among in ((name, seen | True), (f"{name}_unseen", ~seen)):
            use = called & (true >= 0) & which & among
            expected[of] = calibration_error(sure[use], (guess == true)[use])
    assert {name: found["calibration"][name] for name in expected} == pytest.approx(expected, abs=1e-12)


@pytest.mark.parametrize("folder", ["labels", "labels_raw"])
def test_a_run_with_an_unknown_id_or_too_few_labels_is_refused(folder: str, tmp_path: Path) -> None:
    write_scored_run(tmp_path)
    (tmp_path / folder / "0.label").write_bytes(bytes(ids(40, 48, 17, 0)))
    with pytest.raises(DataError, match=r"found ids \[17\], expected 0 or one of"):
        score_run(tmp_path, tmp_path / "truth")
    (tmp_path / folder / "0.label").write_bytes(bytes(ids(40, 48, 0)))
    with pytest.raises(DataError, match="found 3 labels for 4 points"):
        score_run(tmp_path, tmp_path / "truth")


def test_the_truth_may_have_another_origin_than_the_map(tmp_path: Path) -> None:
    write_scored_run(tmp_path)
    true_frame, map_frame = LocalFrame(49.0, 8.4, 110.0), LocalFrame(49.01, 8.41, 90.0)
    T_map_imu = np.tile(np.eye(4), (20, 1, 1))
    T_map_imu[:, 0, 3] = np.arange(20.0)
    truth = Trajectory(0.1 * np.arange(20), T_map_imu)
    write_tum(truth, tmp_path / "truth" / "trajectory_lidar.tum")
    (tmp_path / "truth" / "world.json").write_text(json.dumps(asdict(true_frame)))
    truth.moved(map_frame.pose_of(true_frame)).save(tmp_path / "trajectory.parquet")
    (tmp_path / "run.json").write_text(json.dumps({"local_frame": asdict(map_frame)}))
    found = score_run(tmp_path, tmp_path / "truth")["trajectory"]
    assert found["ate_m"] == pytest.approx(0.0, abs=1e-5)
    assert found["tilt_rms_deg"] == pytest.approx(0.0, abs=1e-5)
    before = (tmp_path / "metrics.json").read_bytes()
    (tmp_path / "truth" / "world.json").write_text(json.dumps(asdict(LocalFrame(52.0, 8.4, 110.0))))
    with pytest.raises(DataError, match=r"trajectory_lidar\.tum: found poses 33\d km from .*world\.json"):
        score_run(tmp_path, tmp_path / "truth")
    assert (tmp_path / "metrics.json").read_bytes() == before
    (tmp_path / "truth" / "world.json").write_text('{"lat_deg": 49}')
    with pytest.raises(DataError, match=r"world\.json: expected the origin"):
        score_run(tmp_path, tmp_path / "truth")


def test_a_calibrated_confidence_has_no_calibration_error_and_a_boast_has_its_size() -> None:
    rng = np.random.default_rng(3)
    truth = rng.choice(ids(40, 48, 10, 50, 70), 200_000)
    confidence = rng.uniform(0.2, 1.0, len(truth))
    wrong = rng.random(len(truth)) > confidence
    prediction = np.where(wrong, np.where(truth == 40, 48, 40), truth).astype(np.uint32)
    looks = rng.integers(1, 255, len(truth)).astype(np.uint8)
    seen = np.ones(len(truth), bool)
    counts = metrics.calibration_counts(confidence, prediction, truth, TABLES, looks, seen)
    assert metrics.calibration(counts)["ece"] < 0.005
    boast = metrics.calibration_counts(np.ones(len(truth)), prediction, truth, TABLES, looks, seen)
    assert metrics.calibration(boast)["ece"] == pytest.approx(wrong.mean())


def test_reliability_is_told_apart_by_the_looks_at_a_voxel() -> None:
    truth = ids(*[40] * 10)
    prediction = ids(40, 48, 40, 40, 40, 40, 48, 48, 40, 0)
    looks = np.array([1, 1, 2, 4, 5, 19, 20, 100, 255, 1], np.uint8)  # the last point has no label
    found = metrics.calibration(
        metrics.calibration_counts(np.full(10, 0.8), prediction, truth, TABLES, looks, looks > 2)
    )
    assert {low: group["bins"] for low, group in found["by_looks"].items()} == {
        low: [{"points": 2, "confidence": pytest.approx(0.8), "right": right}]
        for low, right in (("1", 0.5), ("2", 1.0), ("5", 1.0), ("100", 0.5))
    } | {"20": [{"points": 1, "confidence": pytest.approx(0.8), "right": 0.0}]}
    assert found["bins"] == [{"points": 9, "confidence": pytest.approx(0.8), "right": pytest.approx(6 / 9)}]


def test_a_drive_of_one_scan_has_no_relative_error() -> None:
    one = Trajectory(np.array([1.0]), np.eye(4)[None])
    scores = score_trajectory(one, one)
    assert scores["ate_m"] == 0.0
    assert not any("rpe" in name for name in scores)
