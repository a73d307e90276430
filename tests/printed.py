"""Compare what a program prints with what a page says that it prints."""

import re

NUMBER = re.compile(r"[-+]?\d+(?:\.\d+)?")


def assert_same_output(printed: str, shown: list[str]) -> None:
    """Compare words exactly, and numbers to a quarter or two of their last digit.

    RANSAC and detectors of other versions of OpenCV may choose other points.
    """
    lines = printed.splitlines()
    assert len(lines) == len(shown), printed
    for ours, theirs in zip(lines, shown):
        assert NUMBER.sub("#", ours).split() == NUMBER.sub("#", theirs).split()
        for a, b in zip(NUMBER.findall(ours), NUMBER.findall(theirs)):
            last_digit = 10.0 ** -len(b.partition(".")[2])
            assert abs(float(a) - float(b)) <= max(0.25 * abs(float(b)), 2.01 * last_digit), ours
