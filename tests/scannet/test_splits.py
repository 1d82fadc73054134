from __future__ import annotations

import json

import pytest

from partialbench.errors import InputError
from renderers.sources.scannet.splits import read_split_files, space_of


def test_scannets_own_lists(tmp_path):
    train, val = tmp_path / "scannetv2_train.txt", tmp_path / "scannetv2_val.txt"
    train.write_text("scene0191_00\r\nscene0191_01\r\n\r\n")
    val.write_text("scene0568_00\n")
    expected = {"scene0191_00": "train", "scene0191_01": "train", "scene0568_00": "test"}
    assert read_split_files([train, val]) == expected
    assert read_split_files([tmp_path]) == expected
    assert set(read_split_files([train]).values()) == {"train"}


def test_json_lists(tmp_path):
    path = tmp_path / "any name.json"
    path.write_text(json.dumps({"train": ["scene0001"], "val": ["scene0002_01"]}))
    assert read_split_files([path]) == {"scene0001": "train", "scene0002_01": "test"}


@pytest.mark.parametrize(
    ("lists", "message"),
    [
        ({"train": "scene0000_00", "test": []}, "'train' is \"scene0000_00\", expected a list"),
        ({"train": ["scene0000_00"], "test": ["scene0000"]}, "scene0000_00 and scene0000"),
        ({"train": ["scene0000_00"], "test": ["scene0000_02"]}, "scene0000_00 and scene0000_02"),
        ({"train": [470], "test": []}, "holds 470"),
        ({"train": [""], "test": []}, "holds"),
        (
            {"train": ["scene0000_00.sens"], "test": []},
            r'holds "scene0000_00.sens", expected scene',
        ),
        ({"train": ["scans/scene0000_00"], "test": []}, "expected scene ids like scene0470_00"),
        ({"training": []}, "expected JSON"),
        ({"train": [], "tset": []}, "what is 'tset'"),
        (["scene0000_00"], "expected JSON"),
        ("scene0000_00", "expected JSON"),
    ],
)
def test_what_is_no_split_is_refused(tmp_path, lists, message):
    path = tmp_path / "split.json"
    path.write_text(json.dumps(lists))
    with pytest.raises(InputError, match=message):
        read_split_files([path])


def test_a_list_that_is_there_twice_is_refused(tmp_path):
    path = tmp_path / "split.json"
    path.write_text('{"train": ["scene0000_00"], "test": [], "train": []}')
    with pytest.raises(InputError, match="a list is there twice"):
        read_split_files([path])


def test_rescans_apart_are_found_across_files(tmp_path):
    train, test = tmp_path / "a_train.txt", tmp_path / "a_test.txt"
    train.write_text("scene0005_00\n")
    test.write_text("scene0005_01\n")
    with pytest.raises(InputError, match="one space would be in both train and test"):
        read_split_files([train, test])


def test_text_must_say_what_it_lists(tmp_path):
    path = tmp_path / "scenes.txt"
    path.write_text("scene0000_00\n")
    with pytest.raises(InputError, match="must say in its name"):
        read_split_files([path])
    path = tmp_path / "train.txt"
    path.write_text("scene0000_00 scene0001_00\n")
    with pytest.raises(InputError, match="expected scene ids"):
        read_split_files([path])
    with pytest.raises(InputError, match="cannot be read"):
        read_split_files([tmp_path / "absent_train.txt"])
    (tmp_path / "empty").mkdir()
    with pytest.raises(InputError, match="holds no list"):
        read_split_files([tmp_path / "empty"])


def test_spaces():
    assert space_of("scene0470_00") == space_of("scene0470_12") == space_of("scene0470")
    assert space_of("office_north") != space_of("office_south")
