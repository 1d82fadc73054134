"""What the command line's little grammars refuse, as wrong usage."""

import numpy as np
import pytest
import typer

from partialbench.arguments import camera, counts


def test_a_camera_and_counts_are_read():
    assert counts("3,2") == (3, 2)
    assert counts("modelnet40") == "modelnet40"
    read = camera("150,151.5,80,60,160,120")
    np.testing.assert_array_equal(read.K, [[150, 0, 80], [0, 151.5, 60], [0, 0, 1]])
    assert (read.width, read.height) == (160, 120)


@pytest.mark.parametrize(
    ("read", "text", "message"),
    [
        (camera, "0,0,1,1,10,10", "focal lengths must be positive"),
        (camera, "9,9,1,1,0,10", "image size must be positive"),
        (camera, "9,9,1,1,10.5,10", "WIDTH is 10.5, expected a whole number"),
        (camera, "9,nan,1,1,10,10", "takes 6 numbers"),
        (camera, "9,9,1,1", "takes 6 numbers"),
        (counts, "inf,5", "takes 2 numbers"),
        (counts, "5,2.5", "TEST is 2.5, expected a whole number"),
    ],
)
def test_what_is_none_is_wrong_usage(read, text, message):
    with pytest.raises(typer.BadParameter, match=message):
        read(text)
