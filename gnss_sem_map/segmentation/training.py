"""Training of a RefineNet on images with label images, as in the paper: on public data first, then on one's own.

The images and the random numbers of a step depend only on the seed and the number of the step. So an interrupted
training continues exactly, and on a CPU the same seed gives the same weights.
"""

from __future__ import annotations

import csv
import math
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from pydantic import BaseModel, ConfigDict, Field
from safetensors import SafetensorError
from torch import nn
from torch.nn.functional import cross_entropy, interpolate

from gnss_sem_map.errors import ConfigError, DataError
from gnss_sem_map.files.ownership import MARKER, write_list
from gnss_sem_map.files.untrusted import refused
from gnss_sem_map.labels.label_set import LabelSet
from gnss_sem_map.process.machine import threads
from gnss_sem_map.process.prefetch import prefetch
from gnss_sem_map.process.run_stats import Progress, silent
from gnss_sem_map.segmentation.checkpoints import (
    LOAD_ERRORS,
    load_strictly,
    network_like,
    read_checkpoint,
    write_network,
)
from gnss_sem_map.segmentation.networks import enough_memory, find_device, normalised, placed
from gnss_sem_map.segmentation.pixels import scaled
from gnss_sem_map.segmentation.refinenet import MEAN, STD, LightWeightRefineNet, RefineNet
from gnss_sem_map.segmentation.training_data import (
    IGNORE,
    LabelledFolder,
    LabelledImages,
    augmented,
    class_weights,
    labelled_images,
)

NETWORK, STATE, LOG = "network.safetensors", "state.pt", "log.csv"
"""Files in the folder of a training: the best weights so far, the state for resuming, and one row per validation."""


class TrainingSettings(BaseModel):
    """How a network is trained."""

    model_config = ConfigDict(frozen=True, extra="forbid")

    architecture: str = Field(
        "light-weight", pattern="^(light-weight|full)$", description="Which kind of RefineNet."
    )
    backbone: str = Field(
        "mobilenet_v2", description="mobilenet_v2 (light-weight), resnet50, resnet101, resnet152."
    )
    width: int = Field(256, ge=8, le=512, description="Channels of the decoder on mobilenet_v2.")
    steps: int = Field(2000, ge=1, description="Optimiser steps.")
    batch_size: int = Field(8, ge=2, description="Crops per step.")
    crop_px: tuple[int, int] = Field(
        (384, 192), description="Width and height of a crop, at the network's scale."
    )
    image_scale: float = Field(
        1.0, ge=0.1, le=4, description="Scale of the images at which the network will be run."
    )
    scale_jitter: float = Field(
        1.5, ge=1, le=4, description="Crops are scaled by up to this factor, up and down."
    )
    learning_rate: float = Field(1e-3, gt=0, description="Of AdamW, at its highest.")
    weight_decay: float = Field(1e-2, ge=0, description="Of AdamW.")
    warmup_steps: int = Field(50, ge=0, description="Steps over which the learning rate rises.")
    precision: str = Field(
        "auto",
        pattern="^(auto|float32|float16|bfloat16)$",
        description="Arithmetic of the layers; auto: float16 on a GPU, float32 elsewhere. bfloat16 is the faster"
        " one on processors that have it.",
    )
    weigh_classes: bool = Field(True, description="Rare classes count more in the loss.")
    validate_every: int = Field(200, ge=1, description="Steps between validations; each is a checkpoint.")
    seed: int = Field(0, ge=0, description="Of the first weights, the crops and the dropout.")


@dataclass(frozen=True)
class TrainingReport:
    """Result of a training."""

    network: Path
    """Safetensors file for `refinenet:`, the best of all validations."""
    best_mean_iou: float
    best_step: int
    steps: int


def train(
    training: Sequence[LabelledFolder],
    validation: Sequence[LabelledFolder],
    out: Path,
    label_set: LabelSet,
    taxonomy: str = "cityscapes",
    ids: str | None = None,
    settings: TrainingSettings | None = None,
    initial: Path | None = None,
    device: str = "auto",
    resume: bool = False,
    progress: Progress = silent,
) -> TrainingReport:
    """Train on folders of images with label PNGs, for the classes of `label_set` and `other`.

    `taxonomy` and `ids` define the ids in the PNGs; `initial` is a checkpoint to start from, whose last layer is kept
    if it has the same class names. NETWORK, STATE and LOG are written to `out`; with `resume`, an interrupted
    training there continues. Raises DataError for wrong images, labels or checkpoints and when the device's memory is
    full, ConfigError when `out` already holds a training, or one with other settings.
    """
    settings = settings or TrainingSettings()
    learnt = labelled_images(training, label_set, taxonomy, ids)
    checked = labelled_images(validation, label_set, taxonomy, ids)
    run = _Run(learnt, settings, initial, find_device(device), out, resume)
    with enough_memory(run.device, "a smaller crop_px, batch_size or image_scale"):
        for step, loss in run.steps(progress):
            if step % settings.validate_every == 0 or step == settings.steps:
                run.checkpoint(step, loss, mean_iou(run.network, checked, settings.image_scale, run.device))
    return TrainingReport(out / NETWORK, run.best[0], run.best[1], settings.steps)


def mean_iou(
    network: nn.Module, data: LabelledImages, scale: float, device: torch.device
) -> tuple[float, NDArray[np.float64]]:
    """Mean intersection over union of the map's classes (`other` is none of them), and that of every class, (c,)."""
    count, prepare = len(data.class_names), normalised(MEAN, STD, device)
    confusion = np.zeros((count, count), np.int64)
    network.eval()
    for index in range(len(data.pairs)):
        pixels, truth = data.read(index)
        with torch.inference_mode():
            logits = network(prepare(scaled(pixels, 1, scale)[None]))
            enlarged = interpolate(logits, truth.shape, mode="bilinear", align_corners=False)
            seen = enlarged.argmax(1)[0].cpu().numpy()
        valid = truth != IGNORE
        confusion += np.bincount(count * truth[valid].astype(int) + seen[valid], minlength=count**2).reshape(
            count, count
        )
    either = confusion.sum(0) + confusion.sum(1) - confusion.diagonal()
    iou = np.where(confusion.sum(1) > 0, confusion.diagonal() / np.maximum(either, 1), np.nan)
    if np.isnan(iou[:-1]).all():
        raise DataError(f"{data.pairs[0][1].parent}: no {data.class_names[:-1]} in the validation labels")
    return float(np.nanmean(iou[:-1])), iou


class _Run:
    """The state of a training: network, optimiser, the step, and the best validation so far."""

    def __init__(
        self, data: LabelledImages, settings: TrainingSettings, initial: Path | None, device: torch.device,
        out: Path, resume: bool,
    ) -> None:  # fmt: skip
        self.settings, self.device, self._data, self._out = settings, device, data, out
        self._prepare = normalised(MEAN, STD, device)
        torch.manual_seed(settings.seed)
        self.network = placed(_first_network(settings, data.class_names, initial), device)
        self._optimiser = torch.optim.AdamW(
            self.network.parameters(), lr=settings.learning_rate, weight_decay=settings.weight_decay
        )
        self._precision = precision_on(device, settings)
        self._scaler = torch.amp.GradScaler(device.type, enabled=self._precision is torch.float16)
        self._weights = torch.from_numpy(class_weights(data)).to(device) if settings.weigh_classes else None
        self._done, self.best = 0, (-1.0, 0)
        if (out / STATE).exists() and not resume:
            raise ConfigError(f"{out}: holds a training; continue it (resume), or choose another folder")
        if (out / STATE).exists():
            self._load()
        _claim(out)

    def steps(self, progress: Progress) -> Iterator[tuple[int, float]]:
        """Train step by step; after each, its number and the mean loss since the last validation."""
        losses: list[float] = []
        for step, (pixels, truth) in self._batches():
            losses.append(self._step(step, pixels, truth))
            progress("training", step, self.settings.steps)
            yield step, float(np.mean(losses))
            if step % self.settings.validate_every == 0:
                losses.clear()

    def _step(self, step: int, pixels: NDArray[np.uint8], truth: NDArray[np.uint8]) -> float:
        for group in self._optimiser.param_groups:
            group["lr"] = learning_rate(step, self.settings)
        torch.manual_seed(self.settings.seed * 1_000_003 + step)
        self.network.train()
        self._optimiser.zero_grad()
        mixed = self._precision is not torch.float32
        with torch.autocast(self.device.type, self._precision, enabled=mixed):
            logits = self.network(self._prepare(pixels))
        enlarged = interpolate(logits.float(), truth.shape[1:], mode="bilinear", align_corners=False)
        target = torch.from_numpy(truth).to(self.device).long()
        loss = cross_entropy(enlarged, target, self._weights, ignore_index=IGNORE)
        if not torch.isfinite(loss):
            raise DataError(f"{self._out}: the loss of step {step} is not finite; lower the learning_rate")
        self._scaler.scale(loss).backward()
        self._scaler.unscale_(self._optimiser)
        nn.utils.clip_grad_norm_(self.network.parameters(), 5.0)
        self._scaler.step(self._optimiser)
        self._scaler.update()
        return loss.item()

    def _batches(self) -> Iterator[tuple[int, tuple[NDArray[np.uint8], NDArray[np.uint8]]]]:
        steps = range(self._done + 1, self.settings.steps + 1)
        return prefetch(lambda step: batch_of(self._data, self.settings, step), steps, threads())

    def checkpoint(self, step: int, loss: float, validation: tuple[float, NDArray[np.float64]]) -> None:
        """Keep the network if it is the best so far, then everything that resuming needs, then a row of the log."""
        with _writing(self._out):
            self._write(step, loss, *validation)

    def _write(self, step: int, loss: float, score: float, iou: NDArray[np.float64]) -> None:
        if score > self.best[0]:
            self.best = score, step
            write_network(
                self._out / NETWORK, self.network, self._data.class_names, self.settings.image_scale
            )
        state = {
            "network": self.network.state_dict(), "optimiser": self._optimiser.state_dict(),
            "scaler": self._scaler.state_dict(), "step": step, "best": list(self.best),
            "settings": self.settings.model_dump(mode="json"), "class_names": list(self._data.class_names),
        }  # fmt: skip
        beside = self._out / f"{STATE}.part"
        torch.save(state, beside)
        beside.replace(self._out / STATE)
        rate = learning_rate(step, self.settings)
        row = [step, f"{rate:.3g}", f"{loss:.5f}", f"{score:.4f}", *(f"{x:.4f}" for x in iou)]
        header = [
            "step",
            "learning_rate",
            "loss",
            "mean_iou",
            *(f"iou {name}" for name in self._data.class_names),
        ]
        _append_row(self._out / LOG, header, row)

    def _load(self) -> None:
        path = self._out / STATE
        try:
            state: dict[str, Any] = torch.load(path, map_location=self.device, weights_only=True)
        except LOAD_ERRORS as error:
            raise refused(path, f"damaged ({type(error).__name__}); remove it, train again") from None
        expected = self.settings.model_dump(mode="json")
        changed = {
            n: (state["settings"].get(n), v) for n, v in expected.items() if state["settings"].get(n) != v
        }
        if changed or state["class_names"] != list(self._data.class_names):
            raise ConfigError(f"{path}: other settings then and now: {changed}; resume with the same ones")
        self.network.load_state_dict(state["network"])
        self._optimiser.load_state_dict(state["optimiser"])
        self._scaler.load_state_dict(state["scaler"])
        self._done, self.best = int(state["step"]), (float(state["best"][0]), int(state["best"][1]))


def precision_on(device: torch.device, settings: TrainingSettings) -> torch.dtype:
    """Number type of the layers; weights and loss stay float32 (Micikevicius et al., ICLR 2018)."""
    automatic = "float16" if device.type == "cuda" else "float32"
    name = automatic if settings.precision == "auto" else settings.precision
    precision: torch.dtype = getattr(torch, name)
    return precision


def learning_rate(step: int, settings: TrainingSettings) -> float:
    """Rising over the first steps, then half a cosine down to zero (Loshchilov and Hutter, ICLR 2017, one period)."""
    rising = min(1.0, step / max(1, settings.warmup_steps))
    return settings.learning_rate * rising * 0.5 * (1 + math.cos(math.pi * (step - 1) / settings.steps))


def batch_of(
    data: LabelledImages, settings: TrainingSettings, step: int
) -> tuple[NDArray[np.uint8], NDArray[np.uint8]]:
    """The crops (b, h, w, 3) and truth (b, h, w) of a step: every image once per round, in its own order."""
    first = (step - 1) * settings.batch_size
    scales = (settings.image_scale / settings.scale_jitter, settings.image_scale * settings.scale_jitter)
    crops = []
    for drawn in range(first, first + settings.batch_size):
        turn, place = divmod(drawn, len(data.pairs))
        order = np.random.default_rng((settings.seed, 0, turn)).permutation(len(data.pairs))
        rng = np.random.default_rng((settings.seed, 1, drawn))
        crops.append(augmented(*data.read(int(order[place])), settings.crop_px, scales, rng))
    return np.stack([seen for seen, _ in crops]), np.stack([truth for _, truth in crops])


def _first_network(
    settings: TrainingSettings, class_names: tuple[str, ...], initial: Path | None
) -> nn.Module:
    if initial is not None:
        return _from_checkpoint(initial, class_names)
    if settings.architecture == "full":
        return RefineNet(len(class_names), settings.backbone)
    layout = {"width": settings.width, "depth_head": False} if settings.backbone == "mobilenet_v2" else {}
    return LightWeightRefineNet(len(class_names), settings.backbone, **layout)


def _from_checkpoint(path: Path, class_names: tuple[str, ...]) -> nn.Module:
    checkpoint = read_checkpoint(path)
    network = network_like(checkpoint)
    load_strictly(network, checkpoint)
    if checkpoint.class_names != class_names:
        name = "clf_conv" if hasattr(network, "clf_conv") else "segm"
        last = network.get_submodule(name)
        if not isinstance(last, nn.Conv2d):
            raise DataError(f"checkpoint {path}: found no last layer {name}")
        setattr(network, name, nn.Conv2d(last.in_channels, len(class_names), 3, 1, 1))
    return network


def _claim(out: Path) -> None:
    """Make the folder of a training; raises ConfigError for one with other files."""
    with _writing(out):
        out.mkdir(parents=True, exist_ok=True)
        own = {STATE, NETWORK, LOG, f"{STATE}.part", f"{NETWORK}.part", MARKER}
        strange = sorted({path.name for path in out.iterdir()} - own)
        ours = (out / STATE).exists() or ((out / MARKER).exists() and not strange)  # a run has a list, too
        if any(out.iterdir()) and not ours:
            raise ConfigError(f"{out}: holds {(strange or [NETWORK])[0]}, no training; choose another folder")
        if not ours:
            write_list(out)


@contextmanager
def _writing(out: Path) -> Iterator[None]:
    try:
        yield
    except (OSError, RuntimeError, SafetensorError) as error:  # the last two are of torch and safetensors
        reason = str(error).splitlines()[0]
        raise refused(out, f"cannot be written ({reason}); free some space there, then resume") from None


def _append_row(path: Path, header: list[str], row: list[object]) -> None:
    """Add a row; rows of that step and later ones, of an interrupted training, are removed."""
    rows: list[list[str]] = []
    if path.exists():
        with path.open(newline="") as file:
            rows = [old for old in list(csv.reader(file))[1:] if old and int(old[0]) < int(str(row[0]))]
    with path.open("w", newline="") as file:
        csv.writer(file).writerows([header, *rows, row])
