import pytest
import torch
from tensordict import NonTensorStack, TensorDict
from torchrl.data import LazyTensorStorage

from coachable.replay.row_storage import RowStorage


@pytest.fixture(params=[6, 10], ids=["full", "not full"])
def storages(request):
    torch.manual_seed(0)
    data = TensorDict({"x": torch.randn(6, 3), "next": {"done": torch.rand(6, 1) < 0.5, "n": torch.arange(6)}}, [6])
    both = RowStorage(request.param), LazyTensorStorage(request.param)
    for storage in both:
        storage.set(torch.arange(6), data)
    return both


@pytest.mark.parametrize(
    "index",
    [
        *(torch.tensor(rows) for rows in ([5, 0, 0], [-1, 2], [2], [[1, 2], [3, 4]])),
        *(torch.tensor(rows, dtype=dtype) for rows, dtype in (([], torch.long), ([1, 2], torch.int32))),
        *(3, slice(1, 4), [4, 1]),
    ],
    ids=str,
)
def test_reads_what_the_parent_reads(storages, index):
    ours, theirs = (storage.get(index) for storage in storages)
    assert ours.batch_size == theirs.batch_size
    assert (ours == theirs).all()


def test_reads_are_copies(storages):
    storages[0].get(torch.tensor([1, 2]))["x"].zero_()
    assert (storages[0].get(slice(0, 6)) == storages[1].get(slice(0, 6))).all()


def test_rows_that_were_never_written_are_refused(storages):
    for storage in storages:
        with pytest.raises(IndexError):
            storage.get(torch.tensor([6]))


def test_entries_that_are_no_tensors_are_read():
    names = [f"row {i}" for i in range(6)]
    storage = RowStorage(6)
    storage.set(torch.arange(6), TensorDict({"x": torch.arange(6), "name": NonTensorStack(*names)}, [6]))
    found = storage.get(torch.tensor([4, 1]))
    assert found["x"].tolist() == [4, 1] and list(found["name"]) == ["row 4", "row 1"]
