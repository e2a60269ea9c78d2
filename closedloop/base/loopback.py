"""Whether an address reaches this computer alone."""

import ipaddress


def is_loopback(host: str) -> bool:
    """Whether an address, or a name, is that of this computer for itself."""
    try:
        return ipaddress.ip_address(host).is_loopback
    except ValueError:
        return host == "localhost"
