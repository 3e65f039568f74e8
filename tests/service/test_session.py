"""What a session takes from a step, apart from the service."""

import math

import numpy as np
import pytest

from specshield.episode.handover import check_signals
from specshield.errors import SampleError
from specshield.robot import STRETCH
from specshield.task import make_task
from specshield.world.occupancy import OccupancyGrid

TASK = make_task(
    OccupancyGrid(np.zeros((20, 20), bool), 0.1), STRETCH, "F[0,1] load > 0.5", signals={"load": 0.0}
)


@pytest.mark.parametrize("signals", [{"weight": 1.0}, {"load": math.inf}, {"load": math.nan}])
def test_signals_that_are_sent_are_checked(signals):
    check_signals(TASK.signals, {"load": 3.0})
    with pytest.raises(SampleError) as caught:
        check_signals(TASK.signals, signals)
    assert caught.value.path == f"signals.{next(iter(signals))}"
