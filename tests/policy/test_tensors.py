import json

import numpy as np
import pytest
from safetensors.numpy import save

from specshield.errors import PolicyError
from specshield.policy.tensors import MAX_HEADER, read_tensors

ARRAYS = {
    "cell": np.arange(12, dtype=np.int32).reshape(3, 4), "code": np.array([[7, 65535]], np.uint16),
    "w": np.array([0.5, -1.0], np.float32), "none": np.empty((0, 3)), "bit": np.array([True, False]),
}  # fmt: skip


def test_a_file_mapped_is_what_its_bytes_are(tmp_path):
    content = save(ARRAYS, metadata={"made": "here"})
    (tmp_path / "policy.safetensors").write_bytes(content)
    mapped, read = read_tensors(tmp_path / "policy.safetensors"), read_tensors(content)
    assert sorted(mapped) == sorted(read) == sorted(ARRAYS)
    for name, array in ARRAYS.items():
        assert mapped[name].dtype == read[name].dtype == array.dtype
        assert np.array_equal(mapped[name], array)
        assert np.array_equal(read[name], array)
        assert mapped[name].flags.writeable
        assert mapped[name].flags.aligned
    mapped["code"][:] = 0  # of this process alone
    assert (tmp_path / "policy.safetensors").read_bytes() == content


def header(**fields):
    text = json.dumps({"w": {"dtype": "F32", "shape": [2], "data_offsets": [0, 8]} | fields}).encode()
    return len(text).to_bytes(8, "little") + text + bytes(8)


def test_arrays_of_a_kind_that_is_not_read_are_named(tmp_path):
    content = header(dtype="BF16", shape=[4])
    (tmp_path / "policy.safetensors").write_bytes(content)
    for source in (content, tmp_path / "policy.safetensors"):
        with pytest.raises(PolicyError, match=r"cannot be read: 'BF16'.* arrays of BOOL, .*, F64"):
            read_tensors(source)


@pytest.mark.parametrize(
    "content",
    [
        b"",
        b"\x80\x04K\x01.",  # a pickle
        (1 << 62).to_bytes(8, "little") + b"{}",
        header(data_offsets=[0, 800]),
        header(data_offsets=[4, 0]),
        header(shape=[1 << 40]),
        header(dtype="O"),
        header()[:-1],
    ],
)
def test_hostile_files_are_refused(tmp_path, content):
    (tmp_path / "policy.safetensors").write_bytes(content)
    for source in (content, tmp_path / "policy.safetensors"):
        with pytest.raises(PolicyError, match="safetensors"):
            read_tensors(source)


def test_a_header_that_is_long_is_not_parsed():
    entry = b'{"dtype": "U8", "shape": [0], "data_offsets": [0, 0]}'
    names = b", ".join(b'"%d": %b' % (i, entry) for i in range(MAX_HEADER // len(entry)))
    content = (len(names) + 2).to_bytes(8, "little") + b"{" + names + b"}"
    with pytest.raises(PolicyError, match=f"header is larger than {MAX_HEADER} bytes"):
        read_tensors(content)
