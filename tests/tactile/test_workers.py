import threading

import pytest

from lerobot_vtrefine.tactile.workers import Workers


@pytest.mark.parametrize("threads", [0, 1, 2, 5])
@pytest.mark.parametrize("count", [0, 1, 3, 64])
def test_every_item_is_done_once(threads, count):
    workers, lock = Workers(threads), threading.Lock()
    for begin in (workers.split, lambda *given: workers.start(*given)()):
        done, numbers = [], []

        def part(number, first, last, done=done, numbers=numbers):
            with lock:
                done.extend(range(first, last))
                numbers.append(number)

        begin(count, part)
        assert sorted(done) == list(range(count))
        assert sorted(numbers) == list(range(len(numbers)))
        assert len(numbers) <= workers.num_threads


def test_work_that_was_started_goes_on_beside_the_caller():
    workers, done = Workers(2), threading.Event()
    wait = workers.start(1, lambda *_: done.set())
    assert done.wait(10.0)
    wait()


def test_who_waits_lends_a_hand():
    workers, names, block = Workers(2), [], threading.Event()

    def part(number, first, last):
        names.append(threading.current_thread().name)
        if number == 0:
            block.wait(10.0)

    wait = workers.start(2, part)
    threading.Timer(0.2, block.set).start()
    wait()
    assert threading.current_thread().name in names  # for the second part, while the first was held up


@pytest.mark.parametrize("bad", [0, 1, 3])
@pytest.mark.parametrize("threads", [1, 4])
def test_what_a_part_raises_reaches_the_caller(threads, bad):
    done = []

    def part(number, first, last):
        if first <= bad < last:
            raise ValueError(f"part {number}")
        done.append(number)

    workers = Workers(threads)
    with pytest.raises(ValueError, match="part"):
        workers.split(4, part)
    with pytest.raises(ValueError, match="part"):
        workers.start(4, part)()
    assert len(done) == 2 * (threads - 1)  # all others were done
