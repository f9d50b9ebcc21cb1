"""Separations limit BLAS to one thread, for one of their threads at a time, as the limit belongs to the process."""

from concurrent.futures import ThreadPoolExecutor
from threading import Event

from threadpoolctl import threadpool_info

from vpl.matrix.separation import _one_core_each


def blas_threads():
    return [pool["num_threads"] for pool in threadpool_info() if pool["user_api"] == "blas"]


def test_a_second_thread_separates_after_the_first_and_blas_gets_its_threads_back():
    entered, before = Event(), blas_threads()
    assert before

    def second():
        with _one_core_each() as each:
            entered.set()
            return each(lambda number: blas_threads(), range(3))

    with ThreadPoolExecutor(1) as pool:
        with _one_core_each():
            found = pool.submit(second)
            assert not entered.wait(0.5)
            assert set(blas_threads()) == {1}
        assert all(set(threads) == {1} for threads in found.result())
    assert blas_threads() == before
