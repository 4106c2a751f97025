"""What a model file says about itself: the metadata entry, its older names, and its errors."""

from __future__ import annotations

import json
from typing import Any

import pytest

from lanestream.errors import ModelError
from lanestream.inference.model_info import METADATA_KEY, ClassifierInfo, RegressorInfo, parse_info
from lanestream.road.crops import PatchGeometry, RoadCropGeometry

COMMON: dict[str, Any] = {
    "name": "n",
    "version": "1",
    "threshold": 0.5,
    "precision": "fp32",
    "training": {},
    "metrics": {},
    "exporter": "",
}
PATCH = {"size": 64, "half_width": 0.4, "min_half_width": 3.0, "obliquity": 0.5}
CLASSIFIER = {**COMMON, "kind": "classifier", "classes": ["other", "boundary"], "temperature": 1.0, "patch": PATCH}
KINDS = {
    **CLASSIFIER,
    "classes": ["nothing", "marking", "road_edge"],
    "types": ["solid", "dashed", "double", "dots"],
    "colors": ["white", "yellow"],
    "color_temperature": 1.5,
}
ROAD_CROP = {"size": 96, "above": 0.1, "narrowest": 0.5, "detail_width": 300}
REGRESSOR = {**COMMON, "kind": "regressor", "road_crop": ROAD_CROP}


def parse(info: dict[str, Any]) -> ClassifierInfo | RegressorInfo:
    return parse_info({METADATA_KEY: json.dumps(info)}, "x.onnx")


def test_a_classifier_describes_its_patches_and_outputs() -> None:
    info = parse(CLASSIFIER)
    assert isinstance(info, ClassifierInfo)
    assert info.patch == PatchGeometry(64, 0.4, 3.0, 0.5)
    assert (info.input_size, info.outputs) == (64, 2)


def test_a_regressor_describes_its_road_crops_and_outputs() -> None:
    info = parse(REGRESSOR)
    assert isinstance(info, RegressorInfo)
    assert info.road_crop == RoadCropGeometry(96, 0.1, 0.5, 300)
    assert (info.input_size, info.outputs) == (96, 15)


def test_a_classifier_of_markings_has_outputs_for_types_and_colors() -> None:
    info = parse(KINDS)
    assert isinstance(info, ClassifierInfo)
    assert info.outputs == 9
    assert (info.types, info.colors) == (("solid", "dashed", "double", "dots"), ("white", "yellow"))
    assert (info.type_temperature, info.color_temperature) == (1.0, 1.5)


def test_a_regressor_of_kinds_has_an_output_more_for_each_side() -> None:
    info = parse({**REGRESSOR, "kinds": ["marking", "road_edge"]})
    assert isinstance(info, RegressorInfo)
    assert info.outputs == 17


def test_files_of_versions_before_0_13_know_only_markings() -> None:
    classifier, regressor = parse(CLASSIFIER), parse(REGRESSOR)
    assert isinstance(classifier, ClassifierInfo)
    assert isinstance(regressor, RegressorInfo)
    assert (classifier.types, classifier.colors, classifier.outputs) == ((), (), 2)
    assert (regressor.kinds, regressor.outputs) == (("marking",), 15)


@pytest.mark.parametrize(
    "change",
    [
        {"types": []},
        {"colors": []},
        {"types": [], "colors": []},
        {"classes": ["nothing", "boundary"]},
        {"classes": ["nothing", "road_edge", "marking"]},
        {"types": ["solid", "dashed"]},
        {"colors": ["yellow", "white"]},
        {"types": ["dashed", "solid", "double", "dots"]},
    ],
)
def test_outputs_that_no_version_has_are_an_error_of_one_line(change: dict[str, Any]) -> None:
    with pytest.raises(ModelError, match="its classes, types and colors are not those of this version") as error:
        parse({**KINDS, **change})
    assert "\n" not in str(error.value)
    assert error.value.hint


@pytest.mark.parametrize("kinds", [[], ["road_edge"], ["road_edge", "marking"]])
def test_kinds_that_no_version_has_are_an_error_of_one_line(kinds: list[str]) -> None:
    with pytest.raises(ModelError, match="its kinds are not those of this version or of an older one") as error:
        parse({**REGRESSOR, "kinds": kinds})
    assert "\n" not in str(error.value)


def test_files_of_versions_before_0_10_are_read() -> None:
    old_patch = {**PATCH, "lean": PATCH["obliquity"]}
    del old_patch["obliquity"]
    old_classifier = {**CLASSIFIER, "strip": old_patch}
    del old_classifier["patch"]
    old_regressor = {**REGRESSOR, "canvas": ROAD_CROP}
    del old_regressor["road_crop"]
    assert parse(old_classifier) == parse(CLASSIFIER)
    assert parse(old_regressor) == parse(REGRESSOR)


@pytest.mark.parametrize(
    ("info", "where"),
    [
        ({**CLASSIFIER, "threshold": 2.0}, "threshold"),
        ({**CLASSIFIER, "patch": {**PATCH, "size": 0}}, "patch"),
        ({**REGRESSOR, "road_crop": {**ROAD_CROP, "narrowest": 0.0}}, "road_crop"),
        ({**REGRESSOR, "extra": 1}, "extra"),
        ({**REGRESSOR, "kinds": ["marking", "wall"]}, "kinds"),
        ({**KINDS, "types": ["solid", "dashed", "double", "botts"]}, "types"),
        ({**KINDS, "classes": ["nothing"]}, "classes"),
        ({**KINDS, "type_temperature": 0.0}, "type_temperature"),
        ({**COMMON, "kind": "oracle"}, METADATA_KEY),
    ],
)
def test_an_invalid_description_is_an_error_of_one_line(info: dict[str, Any], where: str) -> None:
    with pytest.raises(ModelError, match=f"x.onnx has an invalid description: .*{where}") as error:
        parse(info)
    assert "\n" not in str(error.value)


def test_a_file_without_a_description_is_an_error() -> None:
    with pytest.raises(ModelError, match=r"x\.onnx does not describe itself: it has no 'lanestream' metadata") as error:
        parse_info({}, "x.onnx")
    assert "lanestream export" in error.value.hint
