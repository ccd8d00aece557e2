"""Commands that run or train a network: `segment`, `train`."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from gnss_sem_map.cli.console import print_cache, progress_bars, warn
from gnss_sem_map.cli.options import Device, Drive, Format, Set, open_log
from gnss_sem_map.cli.signals import Stopped


def segment(
    drive: Drive,
    out: Annotated[
        Path, typer.Option("-o", "--out", help="Folder for the class probabilities; existing ones are kept.")
    ],
    segmenter: Annotated[str, typer.Option(help="The network: refinenet:FILE, hf:MODEL, onnx:FILE, ...")],
    device: Device = "auto",
    batch_size: Annotated[
        int, typer.Option(min=1, help="Images per batch: one is fastest on a CPU, several on a GPU.")
    ] = 1,
    classes: Annotated[str, typer.Option(help="Class set: a shipped one, or a YAML file.")] = "urban",
    drive_format: Format = None,
) -> None:
    """Class probabilities of all images, once; later runs read them with --segmenter labels:OUT."""
    from gnss_sem_map.labels.label_set import open_label_set
    from gnss_sem_map.segmentation import open_segmenter
    from gnss_sem_map.segmentation.cache import write_cache
    from gnss_sem_map.segmentation.classes import unknown_classes

    log = open_log(drive, drive_format, None)
    label_set = open_label_set(classes)
    network = open_segmenter(segmenter, label_set, device, log.calibration.image_sizes)
    if unknown := unknown_classes(network.class_names, label_set):
        warn([f"{segmenter}: {unknown}"])
    with progress_bars() as progress:
        try:
            report = write_cache(log.images, network, label_set, out, segmenter, batch_size, progress)
        except Stopped as stopped:
            stopped.add_note("segmented images are kept: the same command continues")
            raise
    warn([f"{skip.where}: {skip.reason}" for skip in report.skips])
    print_cache(report, out)


def train(
    data: Annotated[
        list[str],
        typer.Option(
            help="Training data, as IMAGES,LABELS[,EVERY] (folders with the same names); repeatable."
        ),
    ],
    validation: Annotated[list[str], typer.Option(help="Validation data, likewise.")],
    out: Annotated[Path, typer.Option("-o", "--out", help="Folder for the network, its state and the log.")],
    initial: Annotated[Path | None, typer.Option(help="Checkpoint to start from.")] = None,
    taxonomy: Annotated[
        str, typer.Option(help="Taxonomy of the ids in the labels: cityscapes, camvid, FILE.")
    ] = "cityscapes",
    ids: Annotated[
        str | None, typer.Option(help="Kind of id, if the taxonomy has several: train_id, label_id.")
    ] = None,
    classes: Annotated[
        str, typer.Option(help="Class set to learn: a shipped one, or a YAML file.")
    ] = "urban",
    set_: Set = None,
    device: Device = "auto",
    resume: Annotated[bool, typer.Option(help="Continue an interrupted training.")] = False,
) -> None:
    """Train or fine-tune a RefineNet on images with label PNGs (the paper: Cityscapes, then CamVid)."""
    from gnss_sem_map import config
    from gnss_sem_map.labels.label_set import open_label_set
    from gnss_sem_map.segmentation.training import TrainingSettings
    from gnss_sem_map.segmentation.training import train as train_network
    from gnss_sem_map.segmentation.training_data import LabelledFolder

    settings = config.parse(TrainingSettings, set_ or ())
    learnt, checked = ([LabelledFolder.parse(text) for text in texts] for texts in (data, validation))
    with progress_bars() as progress:
        try:
            report = train_network(
                learnt, checked, out, open_label_set(classes), taxonomy, ids, settings,
                initial=initial, device=device, resume=resume, progress=progress,
            )  # fmt: skip
        except Stopped as stopped:
            stopped.add_note("the same command with --resume continues from the last validation")
            raise
    typer.echo(
        f"{report.network}: validation mean IoU {report.best_mean_iou:.3f} at step {report.best_step} of {report.steps}"
    )
