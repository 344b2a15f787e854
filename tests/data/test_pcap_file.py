"""Captures that hold no packets of a lidar that is known: one sentence names the file and says what to do."""

import struct
from pathlib import Path

import pytest

from lio_jax.core.errors import LioJaxError
from lio_jax.data import open_sequence
from lio_jax.data.pcap_file import datagrams
from tests.data.captures import ETHERNET, RAW_IP, Sent, write_pcap

NOW_NS = 1_700_000_000_123_456_000


def fault(path: Path) -> str:
    with pytest.raises(LioJaxError) as raised:
        open_sequence(path)
    message = str(raised.value)
    assert message.startswith(f"{path}: ")
    assert message.endswith(".")
    return message


def test_datagrams_are_what_was_sent(tmp_path: Path) -> None:
    sent = [Sent(NOW_NS + k * 1000, 2000 + k, bytes(range(k % 200)), f"10.0.0.{k}") for k in range(50)]
    path = write_pcap(tmp_path / "a.pcap", sent)
    found = list(datagrams(path, pytest.fail))
    assert [(one.received_ns, one.port, one.data) for one in found] == [one[:3] for one in sent]
    assert [".".join(map(str, one.source)) for one in found] == [one.source for one in sent]
    assert [one.length for one in found] == [len(one.data) for one in sent]
    # from the middle on
    assert list(datagrams(path, pytest.fail, found[30].place)) == found[30:]


def test_of_fragments_the_first_one_states_the_length(tmp_path: Path) -> None:
    path = write_pcap(tmp_path / "a.pcap", [Sent(NOW_NS, 7502, bytes(12608)), Sent(NOW_NS, 7503, bytes(48))])
    whole, short = datagrams(path, pytest.fail)
    assert (whole.length, len(whole.data), short.length) == (12608, 1472, 48)


def test_what_is_not_udp_is_passed_over(tmp_path: Path) -> None:
    path = write_pcap(tmp_path / "a.pcap", [Sent(NOW_NS, 1, b"x")] * 3)
    content = bytearray(path.read_bytes())
    record = 16 + 14 + 20 + 8 + 1
    # another protocol above Ethernet, another one above IP
    content[24 + 16 + 12 : 24 + 16 + 14] = b"\x86\xdd"
    content[24 + record + 16 + 14 + 9] = 6
    path.write_bytes(content)
    assert len(list(datagrams(path, pytest.fail))) == 1


def test_the_padding_of_short_frames_is_no_data(tmp_path: Path) -> None:
    path = write_pcap(tmp_path / "a.pcap", [Sent(NOW_NS, 1, b"xyz")], link=RAW_IP)
    content = path.read_bytes()
    path.write_bytes(content[:24] + struct.pack("<IIII", 1, 0, 46, 46) + content[40:] + bytes(15))
    assert [one.data for one in datagrams(path, pytest.fail)] == [b"xyz"]


def test_another_lidar_s_packets(tmp_path: Path) -> None:
    message = fault(write_pcap(tmp_path / "a.pcap", [Sent(NOW_NS, 6699, bytes(1248))] * 20))
    assert "most of its UDP packets hold 1248 bytes and go to port 6699: they are not those of" in message
    assert "let its driver write a ROS bag of them, and give that." in message


def test_packets_that_were_cut(tmp_path: Path) -> None:
    sent = [Sent(NOW_NS, 2368, b"\xff\xee" + bytes(1204))] * 20
    message = fault(write_pcap(tmp_path / "a.pcap", sent, kept=96))
    assert "its packets were cut to 54 of 1206 bytes when they were recorded; record them whole" in message


def test_a_capture_without_udp(tmp_path: Path) -> None:
    assert "holds no UDP packets over IPv4; record the packets" in fault(write_pcap(tmp_path / "a.pcap", []))


def test_pcapng(tmp_path: Path) -> None:
    (tmp_path / "drive.pcapng").write_bytes(struct.pack("<IIIHHqI", 0x0A0D0D0A, 28, 0x1A2B3C4D, 1, 0, -1, 28))
    message = fault(tmp_path / "drive.pcapng")
    assert "is a pcapng file, which is not read; convert it with Wireshark's 'editcap -F pcap " in message


@pytest.mark.parametrize("content", [b"", b"\xd4\xc3\xb2\xa1", b"PK\x03\x04" + bytes(100)])
def test_files_that_are_no_captures(tmp_path: Path, content: bytes) -> None:
    (tmp_path / "a.pcap").write_bytes(content)
    assert "does not begin as a packet capture does" in fault(tmp_path / "a.pcap")


def test_another_kind_of_link(tmp_path: Path) -> None:
    path = write_pcap(tmp_path / "a.pcap", [Sent(NOW_NS, 2368, bytes(1206))], link=ETHERNET)
    content = bytearray(path.read_bytes())
    content[20:24] = struct.pack("<I", 105)
    path.write_bytes(content)
    assert "was recorded on a link of type 105, which is not read" in fault(path)


def test_a_file_that_cannot_be_read_is_an_error(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    path = write_pcap(tmp_path / "a.pcap", [])

    def refused(*_: object, **__: object) -> None:
        raise PermissionError(13, "Permission denied")

    monkeypatch.setattr(Path, "open", refused)
    assert "cannot be read (Permission denied); check the file and the disk" in fault(path)


def test_a_folder_names_the_captures_in_it(tmp_path: Path) -> None:
    write_pcap(tmp_path / "a.pcap", [])
    with pytest.raises(LioJaxError, match=r"give one of those inside it: a\.pcap\."):
        open_sequence(tmp_path)
