"""Classes are mapped by name, never by index."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from gnss_sem_map.errors import ConfigError
from gnss_sem_map.labels.label_set import OTHER, LabelSet, open_label_set, taxonomy
from gnss_sem_map.labels.roles import Role

URBAN = open_label_set()


def test_the_paper_s_five_classes_are_the_default() -> None:
    assert URBAN.names == ("road", "sidewalk", "vehicle", "building", "vegetation")
    assert URBAN.semantic_kitti_ids.tolist() == [40, 48, 10, 50, 70]


@pytest.mark.parametrize(
    ("name", "target"),
    [("car", "vehicle"), ("tree", "vegetation"), ("pavement", "sidewalk"), ("terrain", OTHER), ("fence", OTHER),
     ("sky", OTHER), ("motorcycle", "vehicle"), ("other", OTHER), ("road", "road")],
)  # fmt: skip
def test_a_source_class_goes_where_the_strict_tables_say(name: str, target: str) -> None:
    row = URBAN.table_from([name])[0]
    assert row.sum() == 1
    assert (*URBAN.names, OTHER)[int(row.argmax())] == target


def test_probability_is_neither_lost_nor_made() -> None:
    names = taxonomy("cityscapes").names
    assert (URBAN.table_from(names).sum(axis=1) == 1).all()


def test_an_unknown_class_is_other_and_listed_with_the_nearest_name() -> None:
    names = ["road", "vegitation", "blimp", "vegitation"]
    assert URBAN.table_from(names).argmax(1).tolist() == [0, 5, 5, 5]
    assert URBAN.unknown(names) == ["vegitation", "blimp"]
    assert "did you mean 'vegetation'" in URBAN.not_known("vegitation")
    with pytest.raises(ConfigError, match="did you mean 'building'"):
        URBAN.index("buildings")


@pytest.mark.parametrize(
    ("name", "target"),
    [("road, route", "road"), ("sidewalk, pavement", "sidewalk"), ("building;edifice", "building"), ("bed ", OTHER),
     ("Traffic Light", OTHER), ("traffic_light", OTHER), ("ROAD", "road"), ("car, auto, automobile", "vehicle"),
     ("On Rails", "vehicle"), ("on-rails", OTHER), ("Lane_Marking_-_General", "road"), ("Truck_Bus", "vehicle")],
)  # fmt: skip
def test_the_spelling_of_a_name_does_not_matter(name: str, target: str) -> None:
    assert URBAN.unknown([name]) == []
    assert (*URBAN.names, OTHER)[int(URBAN.table_from([name])[0].argmax())] == target


def test_every_name_of_every_taxonomy_is_known_and_goes_to_one_class() -> None:
    sizes = {
        "cityscapes": 36,
        "mapillary": 65,
        "ade20k": 150,
        "camvid": 33,
        "kitti6": 6,
        "semantic_kitti": 32,
    }
    for source, size in sizes.items():
        names = taxonomy(source).names
        assert len(names) == size
        assert URBAN.unknown(names) == []
        for name in names:
            assert URBAN.table_from([name]).argmax() == URBAN.of_source(source, name), name


def test_train_ids_and_label_ids_of_the_same_class_agree() -> None:
    cityscapes = taxonomy("cityscapes")
    by_train, by_label = (cityscapes.lookup(URBAN, kind) for kind in ("train_id", "label_id"))
    for name, train_id in cityscapes.ids["train_id"].items():
        assert by_train[train_id] == by_label[cityscapes.ids["label_id"][name]], name
    assert by_train[255] == -1
    assert by_train[77] == -2
    assert by_train[13] == URBAN.index("vehicle")


def test_a_user_s_class_set_is_read_and_checked(tmp_path: Path) -> None:
    file = tmp_path / "mine.yaml"
    row = "{name: %s, colour: [1, 2, 3], semantic_kitti_id: %d, asprs_code: 11}"
    file.write_text(f"name: mine\nclasses: [{row % ('road', 40)}, {row % ('grass', 72)}]\n")
    known = open_label_set(file)
    assert known.names == ("road", "grass")
    again = open_label_set(known.about())
    assert (again.name, again.names, again.about()) == ("mine", known.names, known.about())
    np.testing.assert_array_equal(again.colours, known.colours)
    file.write_text(f"name: mine\nclasses: [{row % ('road', 40)}, {row % ('road', 72)}]\n")
    with pytest.raises(ConfigError, match=r"^class set .mine.: .*different names"):
        open_label_set(file)
    for same in (40, 0):  # labels of points would be those of another class, or of none
        file.write_text(f"name: mine\nclasses: [{row % ('road', 40)}, {row % ('grass', same)}]\n")
        with pytest.raises(ConfigError, match=rf"semantic_kitti_id \[40, {same}\], expected a different one"):
            open_label_set(file)
    file.write_text("name: mine\nclasses: [{name: road}]\n")
    with pytest.raises(ConfigError, match="expected name, classes"):
        open_label_set(file)
    with pytest.raises(ConfigError, match="no class set 'nothing'"):
        open_label_set("nothing")
    # what ships with us for the ids of label images has no colours and codes of a map
    with pytest.raises(ConfigError, match=r"no class set 'cityscapes': expected one of \['urban'\] or"):
        open_label_set("cityscapes")
    with pytest.raises(
        ConfigError, match=r"no taxonomy 'urban': expected one of \['ade20k', 'camvid', 'cityscapes'"
    ):
        taxonomy("urban")


def test_a_user_s_taxonomy_needs_only_a_table_in_the_class_set(tmp_path: Path) -> None:
    mars = tmp_path / "mars.yaml"
    mars.write_text(
        "name: mars\nids: [id]\nclasses: [{name: dust, id: 7}, {name: hut, id: 8}, {name: air, id: 9}]\n"
    )
    mine = replace(URBAN, sources={**URBAN.sources, "mars": {"dust": "road", "hut": "building"}})
    assert taxonomy(mars).lookup(mine, "id")[6:10].tolist() == [-2, 0, 3, 5]
    assert mine.table_from(["dust", "hut", "car"]).argmax(1).tolist() == [0, 3, 2]
    with pytest.raises(ConfigError, match=r"knows no .mars., only .*add it to .sources."):
        taxonomy(mars).lookup(URBAN, "id")


def test_ids_of_semantic_kitti_map_as_the_scoring_protocol_says() -> None:
    table = taxonomy("semantic_kitti").lookup(URBAN, "id", 1 << 16)
    expected = {
        40: 0,
        60: 0,
        48: 1,
        10: 2,
        13: 2,
        15: 2,
        18: 2,
        20: 2,
        252: 2,
        257: 2,
        259: 2,
        50: 3,
        70: 4,
        71: 4,
    }
    assert {i: int(table[i]) for i in expected} == expected
    assert np.isin(table[[44, 72, 51, 80, 30, 16]], [5]).all()


def with_roles(**roles: str | None) -> LabelSet:
    rows = [
        {"name": name, "colour": [1, 2, 3], "semantic_kitti_id": 40 + i, "asprs_code": 11}
        for i, name in enumerate(roles)
    ]
    return open_label_set(
        {
            "name": "mine",
            "classes": [
                row | ({} if role == "" else {"role": role})
                for row, role in zip(rows, roles.values(), strict=True)
            ],
        }
    )


def test_roles_are_those_of_the_file_and_where_it_gives_none_those_of_the_names() -> None:
    by_name = with_roles(Car="", other_vehicle="", lawn="", road="", street="")
    assert by_name.roles == (Role.VEHICLE, Role.VEHICLE, None, Role.ROAD, None)
    assert "Car as vehicle" in by_name.said_of_roles
    given = with_roles(Car=None, strasse="road", amoeba="person", snail="")
    assert given.roles == (None, Role.ROAD, Role.PERSON, None)
    assert (given.the(Role.ROAD), given.the(Role.POLE), given.having(Role.VEHICLE, Role.PERSON)) == (
        1,
        None,
        [2],
    )
    assert given.said_of_roles == URBAN.said_of_roles == ""
    for known in (by_name, given, URBAN):
        assert open_label_set(known.about()).roles == known.roles


def test_roles_that_are_none_and_those_of_two_classes_are_refused() -> None:
    with pytest.raises(ConfigError, match=r"found the role 'rode', expected one of .*'road'"):
        with_roles(road="rode", sidewalk="sidewalk")
    with pytest.raises(ConfigError, match=r"the role road at \['road', 'bridge'\]"):
        with_roles(road="road", bridge="road")
    assert with_roles(car="vehicle", bus="vehicle").having(Role.VEHICLE) == [0, 1]
