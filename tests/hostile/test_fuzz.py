"""Of the inputs that `python -m benchmarks.fuzz` makes, the first few hundred of one seed."""

import pytest

from benchmarks.fuzz import KINDS, many

COUNT, PARTS = 300, 3


@pytest.mark.slow
@pytest.mark.parametrize("part", range(PARTS))
def test_whatever_comes_of_a_spoiled_input_is_an_error_of_ours_or_a_clean_exit(part: int) -> None:
    found = many(1, range(part, COUNT, PARTS))
    assert [failure for tally in found.values() for failure in tally.failures] == []
    assert set(found) == {kind.name for kind in KINDS}
    assert sum(tally.inputs for tally in found.values()) == COUNT // PARTS
