"""Stamps in whole nanoseconds and their decimal text."""

FARTHEST_NS = 9_000_000_000_000_000_000
"""Stamps end here, in the year 2255, on both sides of zero: sums with a recording's length fit int64, too."""


def seconds_to_ns(text: str) -> int:
    """Convert decimal seconds to ns without passing through a float, which cannot hold epoch time to a ns.

    Raises:
        ValueError: the text is not a number, or not a time that int64 nanoseconds can hold.
    """
    whole, _, fraction = text.partition(".")
    seconds = float(text)
    if not abs(seconds) * 1e9 < FARTHEST_NS:
        raise ValueError(f"{text} is not a time in seconds")
    if not fraction.isdecimal() or not whole.isdecimal():
        return round(seconds * 1e9)
    return int(whole) * 1_000_000_000 + int(fraction[:9].ljust(9, "0"))


def ns_to_seconds(stamp_ns: int) -> str:
    """Write ns as decimal seconds with 9 decimals, exactly."""
    sign, stamp = ("-", -stamp_ns) if stamp_ns < 0 else ("", stamp_ns)
    return f"{sign}{stamp // 1_000_000_000}.{stamp % 1_000_000_000:09d}"
