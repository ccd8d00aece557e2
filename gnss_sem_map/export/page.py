"""Pages for people: templates of `assets/` filled with Jinja2, which escapes all that a run says."""

from __future__ import annotations

import base64
from collections.abc import Mapping
from functools import cache
from io import BytesIO
from typing import Any

import numpy as np
from jinja2 import Environment, PackageLoader, StrictUndefined
from numpy.typing import NDArray
from PIL import Image

WORDS = {
    "SA": "static points kept (SA)",
    "DA": "points on moving vehicles removed (DA)",
    "AA": "both, geometric mean (AA)",
    "SA_vehicle": "points on parked vehicles kept",
    "ece": "expected calibration error (ECE)",
    "ate_m": "absolute trajectory error (m)",
    "ate_aligned_m": "the same after alignment (m)",
    "rpe_translation_m": "error of a step of 1 s (m)",
    "rpe_translation_share": "the same as a share of the way",
    "rpe_rotation_deg": "turn error of a step of 1 s (°)",
    "horizontal_rms_m": "horizontal error, rms (m)",
    "vertical_rms_m": "vertical error, rms (m)",
    "heading_rms_deg": "heading error, rms (°)",
    "tilt_rms_deg": "tilt error, rms (°)",
    "imu_noise_inflation": "factor on the noise of the IMU",
    "fix_noise_inflation": "factor on the standard deviations of the fixes",
    "p_imu_antenna_m": "antenna: ahead, left, above of the IMU (m)",
    "chi2_per_dof": "squared residuals divided by their variances (chi2 per degree of freedom)",
    "position_nees_per_dof": "squared position error / claimed variance (NEES per degree of freedom)",
    "orientation_nees_per_dof": "squared orientation error / claimed variance (NEES per degree of freedom)",
    **{
        f"{part}_inside_{share}": f"{part}: errors inside the ellipsoid that should hold {share} %"
        for part in ("position", "horizontal")
        for share in (50, 90, 95)
    },
    "position_scale_gap": "position: scale gap k, above 1 the variances are too small",
    "horizontal_scale_gap": "horizontal: scale gap k, above 1 the variances are too small",
}
UNITS = {"m": "m", "s": "s", "deg": "°", "mb": "MB", "ns": "ns", "px": "px"}


def page(template: str, **content: Any) -> bytes:
    """One self-contained HTML page from a template of `assets/`."""
    return _environment().get_template(template).render(content).encode("utf-8", "backslashreplace")


@cache
def _environment() -> Environment:
    environment = Environment(
        loader=PackageLoader("gnss_sem_map.export", "assets"),
        autoescape=True,
        undefined=StrictUndefined,
        trim_blocks=True,
        lstrip_blocks=True,
    )
    environment.filters |= {"value": value, "words": words, "percent": percent}
    environment.tests |= {"figure": is_figure}
    return environment


def png(content: bytes | NDArray[np.uint8]) -> str:
    """A PNG file, or pixels (h, w, 3) RGB, as the source of an `<img>`."""
    if not isinstance(content, bytes):
        file = BytesIO()
        Image.fromarray(content).save(file, "png")
        content = file.getvalue()
    return f"data:image/png;base64,{base64.b64encode(content).decode('ascii')}"


def percent(share: float | None) -> str | None:
    return None if share is None else f"{100 * share:.1f} %"


def is_figure(content: Any) -> bool:
    """Whether a cell holds a number, which stands right-aligned."""
    return isinstance(content, int | float) or (isinstance(content, str) and content.endswith(" %"))


def value(content: Any) -> str:
    match content:
        case None:
            return "-"
        case bool():
            return "yes" if content else "no"
        case int():
            return f"{content:,}"
        case float():
            return f"{content:.4g}"
        case list() | tuple():
            return ", ".join(map(value, content))
        case Mapping():
            return ", ".join(f"{key} {value(each)}" for key, each in content.items())
        case _:
            return str(content)


def words(key: str) -> str:
    """`peak_memory_mb` -> `peak memory (MB)`, and some abbreviations spelt out."""
    if key in WORDS:
        return WORDS[key]
    *parts, last = key.split("_")
    return " ".join([*parts, f"({UNITS[last]})"] if parts and last in UNITS else [*parts, last])
