"""Which user of this machine has the other end of a connection: the kernel is asked."""

from __future__ import annotations

import errno
import os
import socket
import struct

NETLINK_SOCK_DIAG, SOCK_DIAG_BY_FAMILY, NLM_F_REQUEST, ANY = 4, 20, 1, 0xFFFFFFFF
"""Linux's numbers for a question about one connection."""


def user_of_peer(connection: socket.socket) -> int | None:
    """Return the id of the user who has the other end of a connection within this machine; None: it has gone.

    Source: Linux, sock_diag(7) and include/uapi/linux/inet_diag.h.

    Raises:
        OSError: When the kernel cannot report it.
    """
    try:
        (there, from_port, *_), (here, to_port, *_) = connection.getpeername(), connection.getsockname()
    except OSError:
        return None
    there, here = (socket.inet_pton(connection.family, host).ljust(16, b"\0") for host in (there, here))
    ends = struct.pack("!HH16s16s", from_port, to_port, there, here) + struct.pack("=III", 0, ANY, ANY)
    request = struct.pack("=BBBBI", connection.family, socket.IPPROTO_TCP, 0, 0, ANY) + ends
    with socket.socket(socket.AF_NETLINK, socket.SOCK_DGRAM, NETLINK_SOCK_DIAG) as kernel:
        kernel.send(struct.pack("=IHHII", 16 + len(request), SOCK_DIAG_BY_FAMILY, NLM_F_REQUEST, 1, 0) + request)
        reply = kernel.recv(4096)
    if struct.unpack_from("=H", reply, 4)[0] != SOCK_DIAG_BY_FAMILY:
        (code,) = struct.unpack_from("=i", reply, 16)
        if code == -errno.ENOENT:
            return None
        raise OSError(-code, os.strerror(-code))
    user, inode = struct.unpack_from("=II", reply, 16 + 64)
    return user if inode else None  # without one it has no owner, and its user reads as 0
