"""KITTI's tracklet_labels.xml: boxes of visible objects per frame, in the LiDAR's axes."""

from dataclasses import dataclass
from pathlib import Path

_HEAD = """<?xml version="1.0" encoding="UTF-8" standalone="yes" ?>
<!DOCTYPE boost_serialization>
<boost_serialization signature="serialization::archive" version="9">
<tracklets class_id="0" tracking_level="0" version="0">
\t<count>{count}</count>
\t<item_version>1</item_version>
"""
_TAIL = "</tracklets>\n</boost_serialization>\n"


@dataclass(frozen=True)
class Box:
    """One object in one frame: the middle of its bottom (m) and its heading (rad) in the LiDAR's axes."""

    frame: int
    x: float
    y: float
    z: float
    heading: float


@dataclass(frozen=True)
class Tracklet:
    """One object over a run of frames without a gap; height, width, length in metres."""

    kind: str
    height: float
    width: float
    length: float
    boxes: tuple[Box, ...]


def write_tracklets(path: Path, tracklets: list[Tracklet]) -> None:
    """Write them as the benchmark's own tools do."""
    items = [_item(tracklet, first=k == 0) for k, tracklet in enumerate(tracklets)]
    path.write_text(_HEAD.format(count=len(tracklets)) + "".join(items) + _TAIL)


def _item(tracklet: Tracklet, first: bool) -> str:
    marks = [
        ' class_id="1" tracking_level="0" version="0"',
        ' class_id="2" tracking_level="0" version="0"',
    ] * first
    item, poses = marks or ["", ""]
    boxes = [_pose(box, first and k == 0) for k, box in enumerate(tracklet.boxes)]
    return (
        f"\t<item{item}>\n\t\t<objectType>{tracklet.kind}</objectType>\n"
        f"\t\t<h>{tracklet.height:.6g}</h>\n\t\t<w>{tracklet.width:.6g}</w>\n\t\t<l>{tracklet.length:.6g}</l>\n"
        f"\t\t<first_frame>{tracklet.boxes[0].frame}</first_frame>\n\t\t<poses{poses}>\n"
        f"\t\t\t<count>{len(boxes)}</count>\n\t\t\t<item_version>2</item_version>\n{''.join(boxes)}"
        "\t\t</poses>\n\t\t<finished>1</finished>\n\t</item>\n"
    )


def _pose(box: Box, first: bool) -> str:
    mark = ' class_id="3" tracking_level="0" version="2"' if first else ""
    values = {
        "tx": f"{box.x:.12g}", "ty": f"{box.y:.12g}", "tz": f"{box.z:.12g}", "rx": "0", "ry": "0",
        "rz": f"{box.heading:.12g}", "state": "2", "occlusion": "0", "occlusion_kf": "0", "truncation": "0",
        "amt_occlusion": "-1", "amt_occlusion_kf": "-1", "amt_border_l": "-1", "amt_border_r": "-1",
        "amt_border_kf": "-1",
    }  # fmt: skip
    rows = "".join(f"\t\t\t\t<{name}>{value}</{name}>\n" for name, value in values.items())
    return f"\t\t\t<item{mark}>\n{rows}\t\t\t</item>\n"
