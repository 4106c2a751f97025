"""Model files that are broken or that no machine can run: an error of one line, whichever command meets them."""

from __future__ import annotations

import subprocess
import sys
import zipfile
from collections.abc import Callable, Iterable
from pathlib import Path

import fakes
import onnx
import pytest
from onnx import TensorProto, helper

from lanestream.engine import SHIPPED_MODEL, load_engine
from lanestream.errors import LanestreamError, ModelError
from lanestream.inference.loading import load_model
from lanestream.inference.model_info import require_file

# A petabyte of floats: more than any process can address, so that no machine tries to fill it.
HUGE = [1 << 28, 1 << 10, 1 << 10]
SHIPPED = onnx.load(str(SHIPPED_MODEL))


def write_network(
    path: Path,
    nodes: Iterable[onnx.NodeProto] = (),
    constants: Iterable[TensorProto] = (),
    input_type: int = TensorProto.UINT8,
    metadata: str = "",
) -> None:
    """Writes a network that describes itself as the shipped one does, and adds the largest number in `big`."""
    size = 112
    head = [
        helper.make_node("Cast", ["patches"], ["numbers"], to=TensorProto.FLOAT),
        helper.make_node("ReduceMean", ["numbers"], ["mean"], axes=[2, 3], keepdims=0),
        helper.make_node("Slice", ["mean", "first", "last", "axis"], ["two"]),
    ]
    tail = [
        helper.make_node("ReduceMax", ["big"], ["largest"], keepdims=0),
        helper.make_node("Add", ["two", "largest"], ["probabilities"]),
    ]
    graph = helper.make_graph(
        [*head, *nodes, *tail],
        "graph",
        [helper.make_tensor_value_info("patches", input_type, ["batch", size, size, 3])],
        [helper.make_tensor_value_info("probabilities", TensorProto.FLOAT, ["batch", 2])],
        [integers("first", 0), integers("last", 2), integers("axis", 1), *constants],
    )
    model = helper.make_model(graph, opset_imports=[helper.make_opsetid("", 17)], ir_version=9)
    described = {entry.key: entry.value for entry in SHIPPED.metadata_props}
    helper.set_model_props(model, {"lanestream": metadata} if metadata else described)
    path.write_bytes(model.SerializeToString())


def integers(name: str, *values: int) -> TensorProto:
    return helper.make_tensor(name, TensorProto.INT64, [len(values)], values)


def fill(shape: str) -> onnx.NodeProto:
    return helper.make_node("ConstantOfShape", [shape], ["big"], value=helper.make_tensor("v", 1, [1], [1.0]))


def initializer(dims: list[int], location: str = "") -> TensorProto:
    """Returns the constant `big`, whose data are in the file `location`, or are far too few."""
    tensor = TensorProto(name="big", data_type=TensorProto.FLOAT, dims=dims)
    if location:
        tensor.data_location = TensorProto.EXTERNAL
        tensor.external_data.add(key="location", value=location)
    else:
        tensor.raw_data = bytes(16)
    return tensor


def huge_constant(path: Path) -> None:
    write_network(path, [fill("shape")], [integers("shape", *HUGE)])


def huge_result(path: Path) -> None:
    """The size depends on the batch, so that nothing is known before the first run."""
    nodes = [
        helper.make_node("Shape", ["patches"], ["batch_size"], start=0, end=1),
        helper.make_node("Concat", ["batch_size", "rest"], ["shape"], axis=0),
        fill("shape"),
    ]
    write_network(path, nodes, [integers("rest", *HUGE)])


def huge_initializer(path: Path) -> None:
    write_network(path, constants=[initializer(HUGE)])


def overflowing_initializer(path: Path) -> None:
    write_network(path, constants=[initializer([1 << 40, 1 << 40])])


def missing_external_data(path: Path) -> None:
    write_network(path, constants=[initializer([4], "missing.bin")])


def foreign_external_data(path: Path) -> None:
    write_network(path, constants=[initializer([4], "../../../../etc/passwd")])


def metadata_of_bytes(path: Path) -> None:
    write_network(path, [fill("shape")], [integers("shape", 1)], metadata="~~~~")
    path.write_bytes(path.read_bytes().replace(b"~~~~", b"\xff\xfe\xfd\xfc"))


def cut_off(path: Path) -> None:
    path.write_bytes(SHIPPED_MODEL.read_bytes()[:-1000])


def archive(path: Path) -> None:
    with zipfile.ZipFile(path, "w") as file:
        file.write(SHIPPED_MODEL)


def zeros(path: Path) -> None:
    path.write_bytes(bytes(100_000))


def empty(path: Path) -> None:
    path.touch()


def folder(path: Path) -> None:
    path.mkdir()


@pytest.fixture
def path(tmp_path: Path) -> Path:
    return tmp_path / "x.onnx"


@pytest.mark.parametrize("provider", ["cpu", "openvino"])
@pytest.mark.parametrize(
    "write",
    [
        huge_constant,
        huge_result,
        huge_initializer,
        overflowing_initializer,
        missing_external_data,
        foreign_external_data,
        metadata_of_bytes,
        cut_off,
        archive,
        zeros,
        empty,
        folder,
    ],
)
def test_a_bad_file_is_an_error_of_one_line(
    write: Callable[[Path], None], provider: str, path: Path, capfd: pytest.CaptureFixture[str]
) -> None:
    write(path)
    with pytest.raises(ModelError if provider == "cpu" else LanestreamError) as error:
        load_engine(path, provider, None)
    assert "\n" not in str(error.value)
    assert ".cpp:" not in str(error.value)
    assert error.value.hint
    assert capfd.readouterr() == ("", ""), "the runtimes report it themselves, too"


def test_the_error_says_how_much_memory_is_missing(path: Path) -> None:
    huge_constant(path)
    with pytest.raises(ModelError, match=rf"fails when it runs on cpu: .*memory .* of size {1 << 50}"):
        load_model(path, "cpu").warm_up()


def test_an_input_of_another_type_is_an_error(path: Path) -> None:
    write_network(path, [fill("shape")], [integers("shape", 1)], input_type=TensorProto.FLOAT)
    with pytest.raises(ModelError, match=r"Unexpected input data type"):
        load_model(path, "cpu").warm_up()


def test_the_same_network_with_a_small_constant_runs(path: Path) -> None:
    write_network(path, [fill("shape")], [integers("shape", 1)])
    model = load_model(path, "cpu")
    model.warm_up()
    assert model.run(model.blank(3)).tolist() == [[1.0, 1.0]] * 3


def test_a_file_name_that_is_too_long_is_an_error() -> None:
    with pytest.raises(ModelError, match=r"can't read x+: file name too long"):
        require_file(Path("x" * 300))


@pytest.mark.parametrize("command", [["serve", "--port", "0"], ["doctor", "--json"], ["detect", "image.jpg"]])
def test_every_command_prints_one_line(command: list[str], path: Path) -> None:
    huge_constant(path)
    (path.parent / "image.jpg").write_bytes(fakes.image_file())
    shown = subprocess.run(
        [sys.executable, "-m", "lanestream.cli", *command, "--provider", "cpu", "--model", path.name],
        cwd=path.parent,
        capture_output=True,
        text=True,
        check=False,
        timeout=60,
    )
    assert shown.returncode == 1
    lines = [line for line in shown.stderr.splitlines() if " INFO " not in line and " WARNING " not in line]
    assert len(lines) == 1
    assert lines[0].startswith("error: the model ")
