"""Pictures over several hops of an air that takes time and loses frames, while drones fail."""

from __future__ import annotations

import pytest

from benchmarks.pictures import line, measure_time
from tests.extent import extents


@pytest.mark.no_cover
@pytest.mark.parametrize("size", extents(300_000, 6_000_000))
def test_a_picture_arrives_over_four_hops_though_each_relay_is_killed_once(size: int) -> None:
    result = measure_time(line(4, "wifi-1m", 1.0, 0.1, 1), 1, size, kill=True, most_steps=5000)
    assert result["arrived"] == result["parts"] > size // 40_000
    assert result["altered"] == 0
