"""The report says what the run says, and nothing else runs or loads in it."""

import base64
import re
from dataclasses import replace
from html.parser import HTMLParser
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from factor_graphs.trajectory import Trajectory
from gnss_sem_map.export.report import write_report
from gnss_sem_map.voxels import tiles
from gnss_sem_map.voxels.semantic_map import SemanticMap, State

RUN: dict[str, Any] = {
    "name": "drive 5",
    "epoch_ns": 1317042272349659964,
    "local_frame": {"lat_deg": 49.011212804408, "lon_deg": 8.4228850417969, "alt_m": 112.83},
    "counts": {"scans": 40, "points": 4734738},
    "warnings": ["the fixes are better than they say"],
    "skips": {
        "count": 3,
        "listed": [{"what": "scan", "where": "frames 0 to 113", "reason": "114 files missing"}],
    },
    "seconds": {"mapping": 0.5, "export": 1.25},
    "peak_memory_mb": {"mapping": 409, "export": 580},
    "trajectory": {
        "chi2_per_dof": 1.0312,
        "time_offset_s": None,
        "p_imu_antenna_m": [0.0, -0.32, 0.5],
        "fixes": 90,
        "fixes_rejected": 2,
        "fixes_outside_imu": 50,
    },
    "map": {
        "voxels": 226572,
        "labelled": {"raw": {"road": 15841, "vehicle": 15261}, "refined": {"road": 18497, "vehicle": 11227}},
        "refinement": {
            "steps": [
                {"name": "vehicles", "voxels_changed": 12, "changes": {"vehicle to road": 12}, "skipped": ""}
            ],
            "objects": [{"motion": "moving"}, {"motion": "static"}, {"motion": "moving"}],
            "systematic_errors": 0.1042,
        },
    },
    "versions": {"numpy": "2.4.6", "numba": None},
}
SCORES = {
    "mean_accuracy": 0.9,
    "mean_iou": 0.8123,
    "coverage": 0.75,
    "strict": {"mean_iou": 0.61},
    "classes": {"road": {"accuracy": 0.95, "iou": 0.912}, "vehicle": None},
}
METRICS: dict[str, Any] = {
    "semantics": {"raw": SCORES, "refined": SCORES | {"mean_iou": 0.8567}},
    "dynamic": {"SA": 0.991, "DA": None},
    "trajectory": {"ate_m": 0.123456, "position_inside_90": 0.9123},
    "calibration": {"ece": 0.031},
}
PNG = base64.b64decode(
    "iVBORw0KGgoAAAANSUhEUgAAAAEAAAABCAYAAAAfFcSJAAAADUlEQVR42mNk+M9QDwADhgGAWjR9awAAAABJRU5ErkJggg=="
)


class Page(HTMLParser):
    """Tags must close in order; keeps headings, links, picture sources and table rows."""

    VOID = ("meta", "img", "br")

    def __init__(self, text: str) -> None:
        super().__init__()
        self.verdict = ""
        self.open: list[str] = []
        self.tags: set[str] = set()
        self.headings: list[str] = []
        self.links: list[str] = []
        self.images: list[str] = []
        self.rows: list[list[str]] = []
        self.feed(text)
        assert self.open == []

    def handle_starttag(self, tag: str, attrs: list[tuple[str, str | None]]) -> None:
        self.tags.add(tag)
        values = dict(attrs)
        if tag == "a":
            self.links.append(values["href"] or "")
        elif tag == "img":
            self.images.append(values["src"] or "")
        elif tag == "tr":
            self.rows.append([])
        if tag not in self.VOID:
            self.open.append(tag)

    def handle_endtag(self, tag: str) -> None:
        assert self.open.pop() == tag

    def handle_data(self, data: str) -> None:
        if "h2" in self.open:
            self.headings.append(data)
        elif "li" in self.open or "strong" in self.open:
            self.verdict += f"{data}\n"
        elif "tr" in self.open and self.open[-1] != "tr":
            self.rows[-1].append(data)


def report(folder: Path, run: dict[str, Any], metrics: dict[str, Any]) -> Page:
    write_report(folder, run, metrics)
    return Page((folder / "report.html").read_text("utf-8"))


def test_every_figure_of_the_run_is_on_the_page(tmp_path: Path) -> None:
    page = report(tmp_path, RUN, METRICS)
    for row in (
        ["points", "4,734,738"],
        ["scan", "frames 0 to 113", "114 files missing"],
        ["road", "15,841", "18,497", "95.0 %", "91.2 %", "95.0 %", "91.2 %"],
        ["vehicle", "15,261", "11,227", "-", "-", "-", "-"],
        ["all", "31,102", "29,724", "90.0 %", "81.2 %", "90.0 %", "85.7 %"],
        ["vehicles", "12", "vehicle to road: 12"],
        ["vehicles, moving", "2"],
        ["systematic label error rate, estimated without truth", "10.4 %"],
        ["squared residuals divided by their variances (chi2 per degree of freedom)", "1.031"],
        ["antenna: ahead, left, above of the IMU (m)", "0, -0.32, 0.5"],
        ["absolute trajectory error (m)", "0.1235"],
        ["position: errors inside the ellipsoid that should hold 90 %", "91.2 %"],
        ["static points kept (SA)", "99.1 %"],
        ["expected calibration error (ECE)", "3.1 %"],
        ["points of the classes of the map that the raw map labels", "75.0 %"],
        ["mean IoU, refined, if an unlabelled point is a miss", "61.0 %"],
        ["export", "1.25 s", "580"],
        ["numpy", "2.4.6"],
    ):
        assert row in page.rows
    text = (tmp_path / "report.html").read_text("utf-8")
    assert "26 September 2011, 13:04:32 UTC" in text
    assert "49.011213°, 8.422885°, 112.8 m" in text
    assert "and 2 more" in text
    assert '<p class="warning">the fixes are better than they say</p>' in text
    assert "1 remark below must be read" in page.verdict
    assert "0.12 m root mean square error" in page.verdict
    assert " % of the points whose true class the map has carry a label." in page.verdict
    assert "90.0 % of the labelled points are right" in page.verdict
    assert "3 parts of the recording could not be used: 114 files missing" in page.verdict
    assert "2 of 90 satellite positions were rejected as wrong; 50 were not used: the IMU" in page.verdict


@pytest.mark.parametrize(
    ("epoch_ns", "first_s", "date"),
    [
        (1317042272349659964, 2.0, "26 September 2011, 13:04:34 UTC"),
        (0, 1_700_000_000.5, "14 November 2023, 22:13:20 UTC"),
        (0, 0.0, None),
        (0, 5000.0, None),
    ],
)
def test_the_date_is_that_of_the_first_scan_where_stamps_are_dates(
    epoch_ns: int, first_s: float, date: str | None, tmp_path: Path
) -> None:
    """Those of KITTI odometry are seconds since the first scan, and tell no date."""
    write_report(tmp_path, {"epoch_ns": epoch_ns, "scans_s": [first_s, first_s + 1]}, {})
    text = (tmp_path / "report.html").read_text("utf-8")
    assert ("UTC" in text) == (date is not None)
    assert (date or "not georeferenced") in text


def test_coverage_against_expected_accuracy_has_a_line_of_all_and_one_of_what_is_inferred(
    street: SemanticMap, tmp_path: Path
) -> None:
    stands = street.states != State.REMOVED
    for name, shown, lines in (
        ("with", street, ["all", "not seen by a camera"]),
        ("without", street[~street.inferred], ["all"]),
        ("unlabelled", street[street.labels < 0], []),
    ):
        folder = tmp_path / name
        tiles.write(shown, folder / "refined", None)
        (folder / "perspective.png").write_bytes(PNG)
        page = report(folder, {}, {})
        text = (folder / "report.html").read_text("utf-8")
        assert re.findall(r'<polyline class="[ab]" points="[\d., ]+"><title>(.*?)</title>', text) == lines
        assert ("Lighter: no camera saw it" in text) == (name == "with")
        assert ">other</span>" in text
        if name == "with":
            share = f"{100 * street.inferred.sum() / stands.sum():.1f} %"
            assert ["voxels inferred", share] in page.rows


def test_a_map_without_labels_has_no_rate_of_wrong_ones(tmp_path: Path) -> None:
    about_map = RUN["map"] | {"labelled": {"raw": {"road": 0}, "refined": {"road": 0}}}
    page = report(tmp_path, RUN | {"map": about_map}, {})
    assert not [row for row in page.rows if row and row[0].startswith("systematic label error rate")]


def test_what_is_not_known_is_said_to_be_so(tmp_path: Path) -> None:
    verdict = report(tmp_path, {"name": "x"}, {}).verdict
    for missing in ("driven length", "mapped area", "accuracy of the positions", "accuracy of the classes"):
        assert f"{missing} is not known" in verdict
    assert "no known coordinates" in verdict


@pytest.mark.parametrize("drives", [(), ("a", "b")])
def test_length_and_uncertainty_are_those_of_the_trajectory_while_it_had_scans(
    drives: tuple[str, ...], tmp_path: Path
) -> None:
    """Of several drives, the sum of what the table says of each."""
    stamps = np.arange(0.0, 20.0, 0.1)
    T = np.tile(np.eye(4), (len(stamps), 1, 1))
    T[:, 0, 3] = 2.0 * stamps
    covariances = np.tile(np.diag([1e-4] * 3 + [0.04, 0.01, 0.09]), (len(stamps), 1, 1))
    for folder in [tmp_path / "drives" / name for name in drives] or [tmp_path]:
        folder.mkdir(parents=True, exist_ok=True)
        Trajectory(stamps, T, covariances=covariances).save(folder / "trajectory.parquet")
        (folder / "run.json").write_text('{"scans_s": [0.0, 10.0]}')
    about: dict[str, Any] = {"counts": {"scans": 100}, "scans_s": [0.0, 10.0]}
    if drives:
        about = {"drives": {name: {"scans": 50} for name in drives}}
    page = report(tmp_path, {"name": "x"} | about, {})
    assert f"{'40 m driven in 2 drives' if drives else '20 m driven'} with 100 laser scans" in page.verdict
    # the larger axis of the plane, sqrt(chi2 0.95 of 2 degrees of freedom) * 0.2 m; and 1.96 * 0.3 m
    assert "within 0.49 m in the plane and 0.59 m in height at the median place" in page.verdict
    assert "not checked against independent survey points" in page.verdict
    others = ("Drives", "Trajectory", "Files") if drives else ("Trajectory", "What went in", "Files")
    assert tuple(page.headings) == others


def test_the_report_shows_the_map_of_its_folder(street: SemanticMap, tmp_path: Path) -> None:
    tiles.write(street, tmp_path / "refined", None)
    page = report(tmp_path, {"name": "x"}, {})
    assert len(page.images) == 2  # coverage, and classes after refinement
    assert "m² of ground plan are mapped" in page.verdict
    assert re.search(r"Without a class: (.*) %.* \(no labelled image shows \1 %\)", page.verdict)
    assert page.headings == ["Classes and confidence", "Files"]


def test_a_map_without_labels_has_an_area_and_says_why_it_has_no_classes(
    street: SemanticMap, tmp_path: Path
) -> None:
    unlabelled = replace(
        street,
        labels=np.full_like(street.labels, -1),
        states=np.full_like(street.states, State.UNOBSERVED),
    )
    tiles.write(unlabelled, tmp_path / "refined", None)
    verdict = report(tmp_path, {"name": "x"}, {}).verdict
    assert int(re.findall(r"([\d,]+) m² of ground", verdict)[0]) > 700  # 60 m of 12 m
    assert "Without a class: 100.0 %" in verdict


def test_a_section_without_data_does_not_appear(tmp_path: Path) -> None:
    assert report(tmp_path, {"name": "x"}, {}).headings == []
    assert report(tmp_path, {"name": "x", "counts": {"scans": 1}}, {}).headings == ["What went in"]
    everything = [
        "Classes and confidence",
        "What moved",
        "Trajectory",
        "What went in",
        "What was left out",
    ]
    everything += ["Refinement", "Time and memory", "Versions"]
    assert report(tmp_path, RUN, METRICS).headings == everything


def test_a_map_without_georeference_says_so(tmp_path: Path) -> None:
    report(tmp_path, {"name": "x", "local_frame": None}, {})
    assert "not georeferenced" in (tmp_path / "report.html").read_text("utf-8")


def test_pictures_that_exist_are_embedded_whole_and_files_that_exist_are_linked(tmp_path: Path) -> None:
    (tmp_path / "topview.png").write_bytes(PNG)
    (tmp_path / "map.laz").write_bytes(b"LASF")
    (tmp_path / "refined").mkdir()
    (tmp_path / "unknown.bin").write_bytes(b"")
    page = report(tmp_path, RUN, {})
    (source,) = page.images
    assert base64.b64decode(source.removeprefix("data:image/png;base64,")) == PNG
    assert page.links == ["map.laz", "topview.png", "refined"]


@pytest.mark.parametrize(
    "evil", ["<script>alert(1)</script>", '"><img src=x onerror=alert(1)>', "{{ title }} & {% endblock %}"]
)
def test_nothing_that_the_run_says_becomes_markup(evil: str, tmp_path: Path) -> None:
    run = {
        "name": evil,
        "counts": {evil: evil},
        "warnings": [evil],
        "skips": {"count": 1, "listed": [{"what": evil, "where": evil, "reason": evil}]},
        "seconds": {evil: 1.0},
        "trajectory": {evil: [evil]},
        "map": {
            "labelled": {"raw": {evil: 1}},
            "refinement": {"steps": [{"name": evil, "changes": {evil: 1}}]},
        },
        "versions": {evil: evil},
    }
    page = report(tmp_path, run, {"semantics": {evil: {"classes": {evil: None}}}})
    assert page.tags.isdisjoint({"script", "img"})
    assert [evil, evil] in page.rows


def test_the_page_loads_nothing_from_anywhere(tmp_path: Path) -> None:
    (tmp_path / "topview.png").write_bytes(PNG)
    report(tmp_path, RUN, METRICS)
    text = (tmp_path / "report.html").read_text("utf-8")
    assert "default-src 'none'" in text
    assert not re.findall(r"<script|<link|https?://|@import|url\(", text)


def test_the_reliability_curve_is_told_apart_by_looks_where_there_are_enough_points(tmp_path: Path) -> None:
    def bins(points: int) -> list[dict[str, float]]:
        return [{"points": points, "confidence": c, "right": c - 0.1} for c in (0.3, 0.6, 0.9)]

    groups = {
        "1": {"ece": 0.1, "bins": bins(1000)},
        "2": {"ece": 0.1, "bins": bins(3)},
        "100": {"bins": bins(500)},
    }
    calibration = {"ece": 0.1, "bins": bins(1503), "by_looks": groups}
    report(tmp_path, RUN, METRICS | {"calibration": calibration})
    text = (tmp_path / "report.html").read_text("utf-8")
    assert re.findall(r'<i class="key \w+"></i>([^<]*)<', text) == ["both agree", "1", "100 and more", "all"]
    assert text.count("<polyline") == 4
