"""How many threads products are made by."""

from __future__ import annotations

import pytest

from agent.merging import blas


def test_products_are_made_by_one_thread_and_the_host_gets_its_threads_back(monkeypatch: pytest.MonkeyPatch) -> None:
    host = [4]
    monkeypatch.setattr(blas, "_THREADS", (lambda: host[0], lambda n: host.__setitem__(0, n)))
    with pytest.raises(KeyError), blas.one_thread():
        assert host == [1]
        raise KeyError
    assert host == [4]


def test_the_library_that_numpy_loaded_is_found_and_obeys() -> None:
    threads = blas._threads()
    if threads is None:
        pytest.skip("this NumPy has no OpenBLAS")
    get, put = threads
    before = get()
    try:
        put(2)
        with blas.one_thread():
            assert get() == 1
        assert get() == 2
    finally:
        put(before)
