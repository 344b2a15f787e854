"""Which ports this process and those that it started listen on, and whether others could reach them."""

import socket

import psutil


def listening() -> set[tuple[str, int]]:
    """Return address and port of every socket of this process and its descendants that takes connections."""
    found = set()
    own = psutil.Process()
    for process in (own, *own.children(recursive=True)):
        try:
            connections = process.net_connections("inet")
        except psutil.NoSuchProcess:
            continue
        found |= {(one.laddr.ip, one.laddr.port) for one in connections if one.status == psutil.CONN_LISTEN}
    return found


def other_addresses() -> list[str]:
    """Return the addresses by which other computers reach this one; none where there is no network."""
    kinds = (socket.AF_INET, socket.AF_INET6)
    all_of_them = [one for group in psutil.net_if_addrs().values() for one in group if one.family in kinds]
    # an address of one link only cannot be used without its name
    return [
        one.address
        for one in all_of_them
        if not one.address.startswith(("127.", "fe80")) and one.address != "::1"
    ]


def check_loopback_only(sockets: set[tuple[str, int]]) -> None:
    """Check that sockets listen on loopback, and that no other address of this machine answers there."""
    assert sockets
    assert {address for address, _ in sockets} <= {"127.0.0.1", "::1"}
    for _, port in sockets:
        for address in other_addresses():
            with socket.socket(socket.AF_INET6 if ":" in address else socket.AF_INET) as probe:
                probe.settimeout(5.0)
                assert probe.connect_ex((address, port)) != 0, f"{address} answers at {port}"
