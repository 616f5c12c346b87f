"""The checksum of TensorBoard's records: the kernel beside TensorBoard's own, which is taken before it is replaced."""

import array
import importlib.util
import random

import pytest
from tensorboard.compat.tensorflow_stub import pywrap_tensorflow
from tensorboard.compat.tensorflow_stub.pywrap_tensorflow import PyRecordReader_New
from tensorboard.summary.writer.record_writer import RecordWriter

from heatsplat.callbacks import board
from heatsplat.kernels.checksum import crc_update


@pytest.fixture(scope="module")
def theirs():
    """TensorBoard's module as it is installed."""
    spec = importlib.util.find_spec(pywrap_tensorflow.__name__)
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module


def test_it_is_the_published_checksum():
    """RFC 3720, appendix B.4: 32 bytes of zeros, of ones, and counted upwards; and the usual check value."""
    examples = {
        b"\0" * 32: 0x8A9136AA,
        b"\xff" * 32: 0x62A8AB43,
        bytes(range(32)): 0x46DD794E,
        b"123456789": 0xE3069283,
    }
    for data, expected in examples.items():
        assert crc_update(0, data) == expected


def test_it_is_tensorboards_of_any_bytes_and_in_parts(theirs):
    draw = random.Random(0)
    for count in (0, 1, 7, 8, 12, 1000):
        data = draw.randbytes(count)
        expected = theirs.crc_update(0, data)
        for held in (data, bytearray(data), array.array("B", data)):
            assert crc_update(0, held) == expected
        assert crc_update(crc_update(0, data[: count // 3]), data[count // 3 :]) == expected


def test_what_a_run_writes_is_read_by_tensorboard_as_it_is_installed(theirs, tmp_path):
    assert board.pywrap_tensorflow.crc_update is crc_update is not theirs.crc_update
    records = [random.Random(k).randbytes(1000 * k + 1) for k in range(3)]
    with open(tmp_path / "records", "wb") as file:
        writer = RecordWriter(file)
        for record in records:
            writer.write(record)
        writer.flush()
    for reader in (theirs.PyRecordReader_New, PyRecordReader_New):
        opened = reader(str(tmp_path / "records"))
        for record in records:
            opened.GetNext()
            assert opened.record() == record
