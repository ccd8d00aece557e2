"""Which points the labels of an image mark as movable, before the search for moving objects."""

import numpy as np

from gnss_sem_map.labels.label_set import open_label_set
from gnss_sem_map.mapping.labelled_scans import LabelledScan
from gnss_sem_map.mapping.moving_points import movable_and_known


def test_what_is_other_to_the_map_is_as_unknown_as_what_no_image_shows():
    roles = {"strasse": "road", "cars": "vehicle", "walkers": "person", "houses": "building"}
    classes = [
        {"name": name, "role": role, "colour": [0, 0, 0], "semantic_kitti_id": 40 + i, "asprs_code": 1}
        for i, (name, role) in enumerate(roles.items())
    ]
    label_set = open_label_set({"name": "mine", "classes": classes})
    in_no_image, other = -1, len(classes)
    may_move, is_known = movable_and_known(np.array([in_no_image, 0, 1, 2, 3, other], np.int8), label_set)
    assert may_move.tolist() == [False, False, True, True, False, False]
    assert is_known.tolist() == [False, True, True, True, True, False]


def test_a_void_pixel_gives_its_points_no_label():
    classes = np.array([[0, 0, 0, 0, 0, 0], [243, 2, 2, 2, 2, 2], [2, 2, 2, 2, 2, 243]], np.uint8)
    seen = LabelledScan(*[None] * 9, np.array([0, 1, -1, 2], np.int32), classes)
    assert seen.labels.tolist() == [-1, 0, -1, 5]
