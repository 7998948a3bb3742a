"""Tasks on several threads."""

import threading
import time
from contextlib import nullcontext

import pytest
import torch

from arraygeom.runtime import threads as threads_module
from arraygeom.runtime.threads import (
    in_order,
    in_parallel,
    threads,
    torch_in_one_thread,
)


class Noted(list):
    """Tasks, and True if all were taken."""

    def __init__(self, tasks):
        super().__init__(tasks)
        self.gone = threading.Event()

    def __iter__(self):
        left = super().__iter__()

        def taken():
            task = next(left, None)
            if task is None:
                self.gone.set()
            return task

        return iter(taken, None)


def test_an_error_is_raised_once_no_task_runs_any_more(monkeypatch):
    """No output of a task appears after the clean-up."""
    monkeypatch.setattr(threads_module, "threads", lambda: 2)
    begun, both, done = [], threading.Barrier(2, timeout=300), []

    def slow():
        begun.append("slow")
        both.wait()
        tasks.gone.wait(30)  # by the thread of the one that failed, as soon as it is its turn
        time.sleep(0.2)
        done.append("slow")

    def fails():
        begun.append("fails")
        both.wait()
        raise OSError("full")

    tasks = Noted([slow, fails, lambda: begun.append("third")])
    with pytest.raises(OSError, match="full"):
        in_parallel(tasks)
    assert done == ["slow"]
    assert sorted(begun) == ["fails", "slow"]


@pytest.fixture
def two_threads():
    before = torch.get_num_threads()
    torch.set_num_threads(2)
    yield
    torch.set_num_threads(before)


def test_torch_runs_in_one_thread_beside_the_pool_and_has_its_own_back(two_threads):
    """Else its threads and the pool's are more than there are cores."""
    with torch_in_one_thread():
        assert (torch.get_num_threads(), threads()) == (1, 2)
        with torch_in_one_thread():
            assert threads() == 2
        assert torch.get_num_threads() == 1
    with pytest.raises(OSError, match="full"), torch_in_one_thread():
        raise OSError("full")
    assert (torch.get_num_threads(), threads()) == (2, 2)


@pytest.mark.parametrize("alone", [False, True])
def test_every_task_has_torch_in_its_own_thread_alone(two_threads, alone):
    both, counts = threading.Barrier(2, timeout=60), []

    def task():
        both.wait()
        counts.append((threading.get_ident(), torch.get_num_threads()))

    with torch_in_one_thread() if alone else nullcontext():
        in_parallel([task, task])
    assert [count for _, count in counts] == [1, 1]
    assert len({thread for thread, _ in counts}) == 2
    assert torch.get_num_threads() == 2
    born = []
    other = threading.Thread(target=lambda: born.append(torch.get_num_threads()))
    other.start()
    other.join()
    assert born == [2]


def test_parts_are_computed_on_all_threads_and_come_in_order(two_threads):
    """Each with torch alone, and with the gradient mode of the caller."""
    both, weight = threading.Barrier(2, timeout=300), torch.ones(3, requires_grad=True)

    def part(i):
        if i < 2:
            both.wait()  # two at once, or never
        time.sleep(0.01 * (5 - i))
        assert torch.get_num_threads() == 1
        return i, weight * i

    with torch_in_one_thread():
        made = list(in_order(part, range(5)))
        both.reset()
        with torch.no_grad():
            plain = list(in_order(part, range(5)))
    assert [i for i, _ in made] == [i for i, _ in plain] == list(range(5))
    sum(x.sum() for _, x in made).backward()
    assert weight.grad.equal(torch.full((3,), 10.0))
    assert not any(x.requires_grad for _, x in plain)


def test_few_parts_are_made_ahead(two_threads):
    begun = []
    with torch_in_one_thread():
        made = in_order(begun.append, range(100))
        next(made)
        assert len(begun) <= 3
        made.close()
        assert len(begun) <= 3


def test_an_error_in_a_part_is_raised_once_no_part_is_computed(two_threads):
    both, begun, done = threading.Event(), [], []

    def part(i):
        if i == 0:
            both.wait(300)
            raise OSError("full")
        begun.append(i)
        both.set()
        time.sleep(0.2)
        done.append(i)

    with torch_in_one_thread(), pytest.raises(OSError, match="full"):
        list(in_order(part, range(9)))
    assert begun
    assert sorted(begun) == sorted(done)


def test_parts_stay_in_the_thread_that_torch_has_to_see(two_threads):
    here = threading.get_ident()
    with torch_in_one_thread(), torch.device("cpu"):
        assert set(in_order(lambda _: threading.get_ident(), range(4))) == {here}
    with torch_in_one_thread():  # else what it computes would have one thread
        assert set(in_order(lambda _: threading.get_ident(), range(1))) == {here}
    assert set(in_order(lambda _: threading.get_ident(), range(4))) == {here}


@pytest.mark.parametrize("most", [None, 1])
def test_what_tasks_give_comes_back_in_their_order(monkeypatch, most):
    monkeypatch.setattr("arraygeom.runtime.threads.threads", lambda: 3)
    assert in_parallel([lambda i=i: i * i for i in range(20)], most=most) == [i * i for i in range(20)]
