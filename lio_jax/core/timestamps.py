"""Stamps in whole nanoseconds and their decimal text."""


def seconds_to_ns(text: str) -> int:
    """Convert decimal seconds to ns without passing through a float, which cannot hold epoch time to a ns."""
    whole, _, fraction = text.partition(".")
    if not fraction or not fraction.isdigit() or not whole.isdigit():
        return round(float(text) * 1e9)
    return int(whole) * 1_000_000_000 + int(fraction[:9].ljust(9, "0"))


def ns_to_seconds(stamp_ns: int) -> str:
    """Write ns as decimal seconds with 9 decimals, exactly."""
    sign, stamp = ("-", -stamp_ns) if stamp_ns < 0 else ("", stamp_ns)
    return f"{sign}{stamp // 1_000_000_000}.{stamp % 1_000_000_000:09d}"
