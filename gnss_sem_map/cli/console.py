"""Output on the terminal: progress, warnings, tables and summaries."""

from __future__ import annotations

import json
from collections.abc import Container, Iterable, Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import TYPE_CHECKING, Any, NoReturn

import typer

from gnss_sem_map.cli.logs import PROGRAM, Chosen, StageLog, Terminal
from gnss_sem_map.errors import counted

if TYPE_CHECKING:
    from gnss_sem_map.datasets.ros.contents import Topic
    from gnss_sem_map.preflight.findings import Preflight
    from gnss_sem_map.process.run_stats import Progress
    from gnss_sem_map.segmentation.cache import CacheReport
    from gnss_sem_map.sensor_log import Skip


@contextmanager
def progress_bars() -> Iterator[Progress]:
    """A progress bar per stage on stderr, with --verbose lines; nothing when that is not a terminal, or --quiet."""
    from rich.console import Console
    from rich.progress import (
        BarColumn,
        MofNCompleteColumn,
        Progress,
        ProgressColumn,
        Task,
        TextColumn,
        TimeRemainingColumn,
    )
    from rich.text import Text

    class Throughput(ProgressColumn):
        """Finished steps per second."""

        def render(self, task: Task) -> Text:
            return Text(f"{task.finished_speed or task.speed or 0.0:.2g}/s")

    stage = TextColumn("{task.description:>12}")
    columns = (stage, BarColumn(), MofNCompleteColumn(), Throughput(), TimeRemainingColumn())
    console = Console(stderr=True)
    has_bars = console.is_terminal and Chosen.terminal is Terminal.NORMAL
    with Progress(*columns, console=console, disable=not has_bars, transient=True) as bars:
        tasks: dict[str, Any] = {}
        log = StageLog()

        def show(stage: str, done: int, total: int) -> None:
            log(stage, done, total)
            if stage not in tasks:
                tasks[stage] = bars.add_task(stage, total=total)
            bars.update(tasks[stage], completed=done, total=total)

        yield show


def warn(warnings: Iterable[str]) -> None:
    """Warnings on stderr, a line each; with --quiet only in the log file."""
    for warning in warnings:
        PROGRAM.warning("%s", warning)
        if Chosen.terminal is not Terminal.QUIET:
            typer.echo(f"warning: {warning}", err=True)


def refuse_unlabelled(drive: Path | str) -> NoReturn:
    """Say which sources of labels there are, and end with exit code 1."""
    from gnss_sem_map.segmentation import no_segmenter_message

    message = no_segmenter_message(str(drive))
    PROGRAM.error("%s", message)
    typer.echo(message, err=True)
    raise typer.Exit(1)


def print_run(about: dict[str, Any], out: Path, as_json: bool, stages: Container[str] | None = None) -> None:
    """Summary of a run, with the times of some stages (None: all), in three lines or as JSON."""
    if as_json:
        typer.echo(json.dumps(about))
        return
    counts, seconds = about["counts"], about["seconds"]
    skips = sum(about["skips"]["frames"].values())
    typer.echo(
        f"{about['name']}: {counts.get('scans', 0)} scans, {counts.get('points', 0)} points,"
        f" {about['map']['voxels']} voxels, {counted(skips, 'skip')}"
    )
    done = {stage: value for stage, value in seconds.items() if stages is None or stage in stages}
    typer.echo("  ".join(f"{stage} {value:.1f} s" for stage, value in done.items()))
    _print_passes(about)
    typer.echo(f"results in {out}")


def _print_passes(about: dict[str, Any]) -> None:
    """How far the surfaces of two passes lie from each other."""
    for row in about.get("passes", ()):
        again = (
            f"{row['first']} and {row['second']}"
            if row["first"] != row["second"]
            else f"{row['first']}, again"
        )
        typer.echo(
            f"{again}: {row['bound']} of {row['places']} places bound, surfaces {100 * row['before_m']:.1f} cm apart"
            f" before, {100 * row['after_m']:.1f} cm after"
        )


def print_many(about: dict[str, Any], out: Path, as_json: bool) -> None:
    """Drives and size of a map of several drives; those that failed on stderr."""
    if as_json:
        typer.echo(json.dumps(about))
    else:
        typer.echo(
            f"{counted(len(about['merged']), 'drive')}, {about['map']['voxels']} voxels; results in {out}"
        )
        _print_passes(about)
    warn(f"{name} is left out: {reason}" for name, reason in about["failed"].items())


def print_metrics(metrics: dict[str, Any]) -> None:
    """Accuracy and IoU per class of what a camera saw, before and after refinement, then the single figures."""
    from rich.console import Console
    from rich.table import Table

    raw, refined = metrics["semantics"]["raw"], metrics["semantics"]["refined"]["seen"]
    table = Table(
        title="Semantics, % of the points that a camera saw",
        caption="accuracy: share of the points labelled with the class that belong to it (eq. 14; precision)",
    )
    table.add_column("class")
    for column in ("accuracy raw", "refined", "IoU raw", "refined"):
        table.add_column(column, justify="right")
    for name, after in refined["classes"].items():
        before = raw["classes"][name] or {}
        after = after or {}
        cells = (side.get(figure) for figure in ("accuracy", "iou") for side in (before, after))
        table.add_row(name, *map(_percent, cells))
    means = (side[f"mean_{figure}"] for figure in ("accuracy", "iou") for side in (raw, refined))
    table.add_section()
    table.add_row("mean", *map(_percent, means))
    console = Console(soft_wrap=True)
    console.print(table)
    for line in _single_figures(metrics):
        console.print(line, highlight=False)


def _single_figures(metrics: dict[str, Any]) -> Iterator[str]:
    everywhere, moving = metrics["semantics"]["refined"], metrics["dynamic"]
    yield (
        f"all points      coverage {_percent(everywhere['coverage'])} %,"
        f" strict mean IoU {_percent(everywhere['strict']['mean_iou'])} %, open {_percent(everywhere['open'])} %;"
        f" wrong {_percent(everywhere['wrong'])} % of those called one of the classes"
    )
    yield (
        f"moving vehicles removed {_percent(moving['DA'])} %, static kept {_percent(moving['SA'])} %,"
        f" parked kept {_percent(moving['SA_vehicle'])} %, AA {_percent(moving['AA'])} %"
    )
    yield f"calibration     expected error {_percent(metrics['calibration']['ece'])} %"
    t = metrics.get("trajectory")
    if t is None:
        return
    share = t.get("rpe_translation_share")
    yield (
        f"trajectory      {t['ate_m']:.3f} m absolute, {t['ate_aligned_m']:.3f} m aligned,"
        f" heading {t['heading_rms_deg']:.3f} deg, tilt {t['tilt_rms_deg']:.3f} deg"
        + ("" if share is None else f", {100 * share:.2f} % relative")
    )
    if "position_nees_per_dof" not in t:
        return
    yield (
        f"  squared error over its stated variance (NEES per degree of freedom): position"
        f" {t['position_nees_per_dof']:.2f}, orientation {t['orientation_nees_per_dof']:.2f};"
        " consistent covariances give 1 on average over many drives"
    )
    inside = ", ".join(_percent(t[f"position_inside_{share}"]) for share in (50, 90, 95))
    yield (
        f"  positions inside the ellipsoids that should hold 50, 90, 95 %: {inside} %; scale gap k"
        f" {t['position_scale_gap']:.2f}, above 1 the variances are too small"
    )


def print_cache(report: CacheReport, out: Path) -> None:
    """Number and size of the segmented images, and the option that uses them."""
    if not report.written and not report.skips:
        there = f"all {report.kept} images are segmented" if report.kept else "the drive has no images"
        typer.echo(f"nothing to do: {there}")
    else:
        cost = f" ({report.bytes_per_frame / 1000:.0f} kB each, {report.images_per_second:.1f} images/s)"
        typer.echo(
            f"{report.written} images segmented{cost if report.written else ''}, {report.kept} kept,"
            f" {len(report.skips)} skipped"
        )
    if report.written or report.kept:
        typer.echo(f"now use --segmenter labels:{out}")


def print_preflight(name: str, page: Preflight, skips: Sequence[Skip], out: Path) -> None:
    """One page: every check with its level and its evidence; below it the probable mistake and the remedy.

    What of the log cannot be used comes last.
    """
    from rich.console import Console
    from rich.text import Text

    console = Console(soft_wrap=True)
    styles = {"green": "green", "amber": "yellow", "red": "bold red"}
    console.print(
        f"{name}: the pre-flight is {page.level} ({page.seconds:.1f} s)", highlight=False, markup=False
    )
    for found in page.findings:
        level = str(found.level)
        line = Text.assemble((f"{level:>5}", styles[level]), f"  {found.check}: {found.evidence}")
        console.print(line, highlight=False)
        for more in filter(None, (found.mistake, found.remedy)):
            console.print(f"       {more}", highlight=False, markup=False)
    alike: dict[tuple[str, str], list[Skip]] = {}
    for skip in skips:
        alike.setdefault((skip.what, skip.reason), []).append(skip)
    for (what, reason), group in alike.items():
        more = f" and {len(group) - 1} more" if len(group) > 1 else ""
        console.print(f"left out: {what}, {group[0].where}{more}: {reason}", highlight=False, markup=False)
    console.print(f"results in {out}", highlight=False, markup=False)


def print_topics(topics: Iterable[Topic]) -> None:
    """The topics of a bag: a line each, and what is odd about a topic below it."""
    typer.echo(
        f"{'taken for':<13} {'messages':>9} {'Hz':>7} {'gaps':>5} {'longest s':>9}  topic (type, frame)"
    )
    for topic in topics:
        rate = "-" if topic.rate_hz is None else f"{topic.rate_hz:.1f}"
        longest = f"{topic.longest_gap_s:.2f}" if topic.gaps else "-"
        about = ", ".join(filter(None, (topic.kind, topic.frame)))
        typer.echo(
            f"{topic.taken_for or '-':<13} {topic.messages:>9} {rate:>7} {topic.gaps:>5} {longest:>9}"
            f"  {topic.name} ({about})"
        )
        for note in topic.notes:
            typer.echo(f"{'':<13} {note}")


def _percent(share: float | None) -> str:
    return "-" if share is None else f"{100 * share:.1f}"
