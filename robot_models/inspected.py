"""Descriptions that have passed the inspection, by their exact bytes.

The inspection reads a URDF through yourdfpy, whose import alone costs half a second. The descriptions below
were inspected when they were added, a test inspects them again, and a file that differs in one byte is a
stranger. Files of users are not listed and are inspected at every start.
"""

from collections.abc import Collection
from hashlib import sha256

#: SHA-256 of the UTF-8 text → the joints that were locked when it passed.
PASSED: dict[str, tuple[str, ...]] = {
    # wam4
    "51fa08f4d8042949467159a164bae91e9a255ce1cdc69cb509743c1bb848d321": (),
    # wam7
    "858ac1e59429c214b7b8b8118b47d6e2180854b5f351d19be857509c3c0a6ecb": (),
    # planar2
    "60dab6452f27c3630a398e06bee26beb2ecc8011dc2811167b192e139f8ca9d8": (),
    # pointmass3
    "9957ed631afe2e052f1e3a452638054a904ec10778bd7f131039614d5788d391": (),
    # four_bar
    "5a78c709d9c3574796d8fa9525ca6357be1ce5c4f5f3b7e57cd9563e09837d84": (),
    # five_bar
    "b478e922b6ebb59158c479ccf924e7444c3824cce451f604d0f52dd22f67fea7": (),
    # delta
    "2916d2ff726879aa33ca628d5f0a1d67cf9764abeefe2f0e0417d4ad88527976": (),
    # stewart
    "1e0cec012874a3e5de493e94123dbb3dd08e612a7a8ea0fcbf5ae62cccb79575": (),
    # two_arms
    "03259728eb07cef196ffc88842ede01514d62bf12940a9f8c91f3ab6c6fa4736": (),
    # gripper
    "7c916021ed179fdbd28be0fe96f0b32e525485a77fe1334f66b4f2538304b928": (),
    # peg_gantry
    "c77e2d73997171a9c8739dedaf6721484bea945117679af828102a93799ed7ec": (),
    # fr3
    "7a6748644b414d62171a36822e68a832ee780f38b657e2aad73a7372ea4ead4d": (),
    # kinova
    "a9a0a8a1a21b82419b15293fca47b8a35c57e7200eaf1e39dadb6bfd7e44eabb": (),
    # panda
    "63792d2679f22c4e41cda2c4d9d903644e628970ad0656b9eec8485113941555": (
        "panda_finger_joint1",
        "panda_finger_joint2",
    ),
    # panda_collision
    "582aea6f0dda13e6dca083a9f6776efc31c4782ecadbc92c1c5a586647368808": (
        "panda_finger_joint1",
        "panda_finger_joint2",
    ),
    # ur10
    "16e4d9c85f01d2533fa219d28e2e5a2ce93836be7afaf243b46be4ba76e0d4ea": (),
    # ur10_limited
    "47efc7cc109c0d49d3d23d8845e602c3396bfe5e7f6f533909b29c318493dda1": (),
    # ur3
    "679f2ee7e9b182e746a5a93b53a336ae8dffc63ec554c272b2c8ba3692d086eb": (),
    # ur3_gripper
    "ed726f227992641e0f24b4991e0b4edece4b769880c965cf0e8ac19437c5b45c": (),
    # ur3_limited
    "356dd55ebd3a83ed6bc7f55434acafa4876551eb66008adc1830aa7043beceda": (),
    # ur5
    "cede880fc2a987ef9dd23bbcda3e0ad1e7b1df8b58d638d100cfbff8ebc806cb": (),
    # ur5_gripper
    "9b312a5e616ee115c975e6a86df70f97c6b3aa7446f551016c6093186c97bfd1": (),
    # ur5_limited
    "8b8daa5ee444419b44da46bbb994a4e7d41b496d2caa5c4bf996d1cd5706ba64": (),
}


def digest(text: str) -> str:
    """Return the key of a text in `PASSED`."""
    return sha256(text.encode()).hexdigest()


def has_passed(text: str, locked: Collection[str]) -> bool:
    """Tell whether this very text has passed with these joints locked, or with fewer.

    Locking a joint more never adds a fault, so what passed with some joints locked passes with more.
    """
    passed = PASSED.get(digest(text))
    return passed is not None and set(passed) <= set(locked)
