"""Robot files with one fault each, or with a change that must change nothing, and what the loader makes of them.

    python tests/fuzz/robot_files.py --seed 3 --count 2000     # prints what is not clean

Clean is one line of the project's own error, or a model that equals what an independent reader takes from the very same
file: yourdfpy with the oracle for a URDF, MuJoCo for an MJCF. A traceback, anything on standard error, a number that is
not finite, a file that takes too long or kills the process, and an MJCF that MuJoCo refuses and the loader accepts
are not.
"""

import argparse
import multiprocessing
import os
import tempfile
import traceback
import warnings
from collections import Counter
from collections.abc import Callable, Iterator
from dataclasses import dataclass, replace
from functools import cache
from pathlib import Path
from random import Random
from typing import TYPE_CHECKING
from xml.etree import ElementTree as ET

if TYPE_CHECKING:
    import robot_models

#: Seconds for one file, far beyond what the largest that is accepted takes on a busy machine.
PATIENCE = 60.0


@dataclass(frozen=True)
class Case:
    """A robot file: its bytes, and whether it must load as the same robot as its original."""

    name: str
    suffix: str
    data: bytes
    original: bytes
    same: bool = False


@dataclass(frozen=True)
class Outcome:
    """What became of a case: "refused", "loaded", or what is wrong."""

    case: Case
    kind: str
    text: str = ""

    @property
    def clean(self) -> bool:
        """Whether nothing is wrong."""
        return self.kind in ("refused", "loaded")


_INERTIAL = (
    '<inertial><origin xyz="0.1 0.02 0.3" rpy="0.1 -0.2 0.3"/><mass value="2.5"/>'
    '<inertia ixx="0.10" iyy="0.12" izz="0.05" ixy="0.01" ixz="0.002" iyz="0.003"/></inertial>'
)
URDF = f"""<?xml version="1.0"?>
<robot name="sample">
  <material name="grey"><color rgba="0.5 0.5 0.5 1"/></material>
  <link name="base">{_INERTIAL}</link>
  <link name="upper">{_INERTIAL}
    <visual><origin xyz="0 0 0.1"/><geometry><box size="0.1 0.1 0.3"/></geometry><material name="grey"/></visual>
    <collision><geometry><cylinder radius="0.1" length="0.2"/></geometry></collision>
  </link>
  <link name="fore">{_INERTIAL}</link>
  <link name="slider">{_INERTIAL}</link>
  <link name="hand">{_INERTIAL}</link>
  <link name="tip"/>
  <joint name="shoulder" type="revolute"><origin xyz="0 0 0.5" rpy="0.3 0 -1"/><parent link="base"/>
    <child link="upper"/><axis xyz="0 1 0"/><limit lower="-1" upper="1.5" effort="5" velocity="2"/>
    <dynamics damping="0.1" friction="0.2"/></joint>
  <joint name="elbow" type="continuous"><origin xyz="0.1 0 0.5"/><parent link="upper"/><child link="fore"/>
    <axis xyz="0.6 0 0.8"/><limit effort="0" velocity="0"/></joint>
  <joint name="rail" type="prismatic"><origin rpy="0 1.2 0"/><parent link="fore"/><child link="slider"/>
    <axis xyz="1 0 0"/><limit lower="0" upper="0.4" effort="50" velocity="1"/></joint>
  <joint name="palm" type="fixed"><origin xyz="0 0.1 0.2" rpy="1 2 3"/><parent link="slider"/>
    <child link="hand"/></joint>
  <joint name="end" type="fixed"><origin xyz="0 0 0.1"/><parent link="hand"/><child link="tip"/></joint>
</robot>
"""
MJCF = """<mujoco model="sample">
  <compiler angle="degree" eulerseq="xyz"/>
  <option gravity="0 0 -9.81" timestep="0.002"><flag contact="disable"/></option>
  <default><geom rgba="0.5 0.5 0.5 1" density="900"/><joint armature="0.1" damping="1"/>
    <default class="light"><joint armature="0.01" range="-40 40"/><geom contype="1"/></default></default>
  <asset><material name="grey" rgba="0.5 0.5 0.5 1"/></asset>
  <worldbody>
    <light pos="0 0 3"/><geom name="floor" type="plane" size="2 2 0.1"/><site name="mark" pos="1 0 0"/>
    <body name="base" pos="0.1 0 0.2" euler="10 20 30">
      <geom name="foot" type="box" size="0.1 0.1 0.05" material="grey"/>
      <body name="upper" pos="0 0 0.3" quat="0.9 0.1 0.2 0.3" childclass="light">
        <joint name="shoulder" type="hinge" axis="0 1 0" pos="0.01 0.02 0" range="-90 90" actuatorfrcrange="-5 5"/>
        <inertial pos="0.1 0.02 0.3" mass="2" diaginertia="0.1 0.12 0.15" quat="0.8 0 0.6 0"/>
        <geom type="capsule" size="0.05" fromto="0 0 0 0.1 0.2 0.5"/>
        <body name="fore" pos="0 0.3 0.5" axisangle="0 1 1 40">
          <joint name="elbow" class="light" axis="1 1 0"/>
          <inertial pos="0 0 0.1" mass="1.5" fullinertia="1 1.2 1.3 0.1 0.2 0.3"/>
          <body name="slider" pos="0 0 0.2" xyaxes="0 1 0 -1 0 1">
            <joint name="rail" type="slide" axis="0 0 1" range="0 0.4" frictionloss="0.1"/>
            <geom type="cylinder" size="0.1 0.3" mass="3"/><geom size="0.1" pos="0.2 0 0" zaxis="1 2 3"/>
            <body name="hand" pos="0 0 0.2" zaxis="1 0 1">
              <geom type="ellipsoid" size="0.1 0.2 0.15" density="500"/>
              <site name="touch" pos="0 0.1 0.2" size="0.01"/></body>
          </body></body></body></body>
  </worldbody>
  <contact><exclude body1="upper" body2="fore"/></contact>
  <actuator><motor name="drive" joint="shoulder" gear="2"/></actuator>
  <sensor><jointpos name="angle" joint="elbow"/></sensor>
  <keyframe><key name="home" qpos="0.1 0.2 0.3"/></keyframe>
</mujoco>
"""

_BLANKS = (" ", "\t", "\n", "\r\n", "\u00a0", "\u2003", "\u3000", " \t\n ")
_WORDS = (
    *("", " ", "x", "nan", "inf", "-Infinity", "1e999", "1e-400", "1e308", "1e200", "-1e154", "0", "-0.0", "-1"),
    *("1e-320", "1,5", "0x10", "1_0", "\u0661", "1\u200b", "1d3", "--1", "1e", ".", "99999999999999999999", "true"),
    *("base", "elbow", "1e-30", "\u00e9", "1;2", "'", "&lt;", "%n", "../../etc", "a" * 3000),
)


def _elements(text: str) -> Iterator[tuple[ET.Element, list[ET.Element], list[ET.Element]]]:
    """Yield, for each element in turn, a fresh tree, its elements, and the parents of these."""
    count = sum(1 for _ in ET.fromstring(text).iter())
    for k in range(count):
        root = ET.fromstring(text)
        parents = {child: parent for parent in root.iter() for child in parent}
        every = list(root.iter())
        yield every[k], every, [parents.get(e, root) for e in every]


@cache
def _all_tree_cases() -> tuple[Case, ...]:
    return (*_tree_cases("urdf", URDF, ".urdf"), *_tree_cases("mjcf", MJCF, ".xml"))


def _tree_cases(origin: str, text: str, suffix: str) -> Iterator[Case]:
    """Yield all changes of one element or one attribute."""
    original = text.encode()

    def case(what: str, root: ET.Element, same: bool = False) -> Case:
        return Case(f"{origin}: {what}", suffix, ET.tostring(root, encoding="utf-8"), original, same)

    for k, (element, every, parents) in enumerate(_elements(text)):
        root, parent = every[0], parents[k]
        at = f"<{element.tag}> {element.get('name') or k}"
        keys = list(element.attrib)
        for key in keys:
            value = element.attrib[key]
            words = value.split()
            if suffix == ".xml" and "material" in (key, element.tag):
                continue  # how a body looks is left out, whatever it says
            for blank in _BLANKS:
                for where, padded in (("before", blank + value), ("after", value + blank), ("in", blank.join(words))):
                    if where == "in" and (len(words) < 2 or not _is_numbers(words)):
                        continue
                    element.set(key, padded)
                    # MuJoCo takes blanks of ASCII between numbers; in a name they count.
                    same = suffix == ".urdf" or (blank.isascii() and _is_numbers(words))
                    yield case(f"{at}: blank {blank!r} {where} {key}", root, same)
            swaps = [(f"is {word[:20]!r}", word) for word in _WORDS]
            swaps += [("has one more", value + " 0"), ("has one less", " ".join(words[:-1]))]
            swaps += [
                ("is negative", " ".join(_negative(word) for word in words)),
                ("is all 0", " ".join("0" for _ in words)),
            ]
            swaps += [
                ("has a first nan", " ".join(["nan", *words[1:]])),
                ("has a huge last", " ".join([*words[:-1], "1e300"])),
            ]
            swaps += [("is long", " ".join(words * 50)), ("has a comma", value.replace(" ", ",", 1))]
            for what, new in swaps:
                if new != value:
                    element.set(key, new)
                    yield case(f"{at}: {key} {what}", root)
            del element.attrib[key]
            yield case(f"{at}: no {key}", root)
            element.set(key + "x", value)
            yield case(f"{at}: {key} misspelt", root)
            del element.attrib[key + "x"]
            element.set(key, value)
        for added in ("colour", "quat_xyzw", "childclass", "stiffness", "limited", "xmlns"):
            if added not in element.attrib:
                element.set(added, "0 0 0 1")
                yield case(f"{at}: an attribute {added}", root)
                del element.attrib[added]
        if element is root:
            continue
        at_ = list(parent).index(element)
        parent.insert(at_, ET.Comment(" a remark "))
        yield case(f"{at}: a remark before it", root, True)
        del parent[at_]
        parent.insert(at_, element)
        yield case(f"{at}: twice", root)
        del parent[at_]
        tag, element.tag = element.tag, element.tag + "s"
        yield case(f"{at}: misspelt", root)
        element.tag = tag
        parent.remove(element)
        yield case(f"{at}: missing", root)
        root.append(element)
        yield case(f"{at}: at the end of the file", root)
        root.remove(element)
        parent.insert(at_, element)
        inner = list(element)
        if inner:
            element[:] = []
            yield case(f"{at}: empty", root)
            element[:] = inner[::-1]
            yield case(f"{at}: turned round", root)
            element[:] = inner


def _is_numbers(words: list[str]) -> bool:
    return all(word.replace(".", "").replace("-", "").replace("e", "").isdigit() for word in words)


def _negative(word: str) -> str:
    return word[1:] if word.startswith("-") else "-" + word


def _byte_cases(origin: str, text: str, suffix: str, random: Random) -> Iterator[Case]:
    """Yield damage that does not know of XML, and changes of the writing that mean nothing."""
    data = text.encode()
    body = data.split(b"?>")[-1]

    def case(what: str, new: bytes, same: bool = False) -> Case:
        return Case(f"{origin}: {what}", suffix, new, data, same)

    yield case("byte order mark", b"\xef\xbb\xbf" + data, True)
    yield case("lines of Windows", data.replace(b"\n", b"\r\n"), True)
    yield case("a remark at the end", data + b"<!-- end -->", True)
    yield case("single quotes", data.replace(b'"', b"'"), True)
    yield case("tabs between attributes", data.replace(b'" ', b'"\t'), True)
    yield case("hexadecimal references", data.replace(b'="1', b'="&#x31;'), True)
    yield case("UTF-16", text.split("?>")[-1].encode("utf-16"))
    yield case("UTF-16 said", ('<?xml version="1.0" encoding="utf-16"?>' + text.split("?>")[-1]).encode("utf-16"))
    yield case("Latin-1 said", b'<?xml version="1.0" encoding="latin-1"?>' + body)
    yield case("XML 1.1", b'<?xml version="1.1"?>' + body)
    yield case("entity", b'<!DOCTYPE a [<!ENTITY b "1">]>' + body)
    yield case("twice", data + body)
    yield case("junk behind", data + b"\0\0")
    yield case("CDATA", body.replace(b"><", b"><![CDATA[ 1 ]]><", 1))
    yield case("text inside", body.replace(b"><", b"> 1 <"))
    yield case("namespace", body.replace(b"<robot", b'<robot xmlns="u"').replace(b"<mujoco", b'<mujoco xmlns="u"'))
    for _ in range(60):
        at = random.randrange(len(data))
        yield case(f"cut at {at}", data[:at])
        yield case(f"byte {at} dropped", data[:at] + data[at + 1 :])
        yield case(f"byte {at} changed", data[:at] + bytes([random.randrange(1, 256)]) + data[at + 1 :])
        to = random.randrange(len(data))
        yield case(f"a piece moved {at} {to}", data[:at] + data[to : to + 30] + data[at:])


def all_cases(seed: int) -> list[Case]:
    """Return every case that there is, some 15 000, in an order of its own for each seed."""
    random = Random(seed)
    found: list[Case] = list(_all_tree_cases())
    for origin, text, suffix in (("urdf", URDF, ".urdf"), ("mjcf", MJCF, ".xml")):
        found += _byte_cases(origin, text, suffix, random)
    random.shuffle(found)
    return found


def generate(seed: int, count: int) -> list[Case]:
    """Return `count` cases: as many URDF as MJCF, a quarter of them changes that must change nothing."""
    found = all_cases(seed)
    chosen: list[Case] = []
    for suffix in (".urdf", ".xml"):
        for same, share in ((True, count // 8), (False, count // 2 - count // 8)):
            chosen += [case for case in found if case.suffix == suffix and case.same == same][:share]
    Random(seed).shuffle(chosen)
    return chosen


# ---- what happens in the process that may hang or die ---------------------------------------------------------------


Reader = Callable[[Path], "robot_models.RobotModel"]


def _worker(pipe: "multiprocessing.connection.Connection", folder: str, reader: Reader | None) -> None:
    """Load files as they come and say what became of them: once for the loader, once for the comparison."""
    os.chdir(folder)  # MuJoCo writes its log where it stands
    with open("stderr", "w+b") as stream:
        os.dup2(stream.fileno(), 2)
        while True:
            case = pipe.recv()
            path = Path(folder, "robot" + case.suffix)
            path.write_bytes(case.data)
            stream.truncate(0)
            kind, text, robot = _load(path, reader)
            said = Path("stderr").read_bytes().strip(b"\0 \n").decode(errors="replace")
            pipe.send(("noise", said) if said else (kind, text))
            if robot is not None and not said:
                try:
                    with warnings.catch_warnings():
                        warnings.simplefilter("ignore")  # those of the other reader
                        pipe.send(("compared", _compare(case, path, robot)))
                except Exception:
                    pipe.send(("compared", traceback.format_exc()))


def _load(path: Path, reader: Reader | None) -> tuple[str, str, "robot_models.RobotModel | None"]:
    import robot_models

    try:
        with warnings.catch_warnings():
            warnings.simplefilter("error")
            robot = (reader or robot_models.load)(path)
    except robot_models.ModelError as error:
        text = str(error)
        short = "\n" not in text and 0 < len(text) < 600 + 4 * len(str(path))
        return ("refused", text, None) if short else ("wordy", text[:2000], None)
    except BaseException:
        return "traceback", traceback.format_exc(), None
    return "loaded", "", robot


def _compare(case: Case, path: Path, robot: "robot_models.RobotModel") -> str:
    """Return what the model has different from what the independent reader says, or nothing."""
    import independent

    if case.same:
        reference = path.with_name("original" + case.suffix)
        reference.write_bytes(case.original)
        return independent.same_robot(robot, reference)
    return independent.urdf(robot, path) if robot.format == "urdf" else independent.mjcf(robot, path)


# ---- what watches it ------------------------------------------------------------------------------------------------


def run(cases: list[Case], patience: float = PATIENCE, reader: Reader | None = None) -> list[Outcome]:
    """Load every case in a process that is ended when a file takes longer than `patience`, s.

    `reader` stands in for `robot_models.load`, to see whether what it does wrong is found.
    """
    context = multiprocessing.get_context("spawn")
    outcomes = []
    with tempfile.TemporaryDirectory() as folder:
        process = None
        try:
            for case in cases:
                if process is None or not process.is_alive():
                    ours, theirs = context.Pipe()
                    process = context.Process(target=_worker, args=(theirs, folder, reader), daemon=True)
                    process.start()
                    theirs.close()
                outcome = _watch(case, ours, patience)
                if outcome.kind in ("hang", "died"):
                    process.kill()
                    process.join()
                    process = None
                outcomes.append(outcome)
        finally:
            if process is not None:
                process.kill()
                process.join()
    return outcomes


def _watch(case: Case, pipe: "multiprocessing.connection.Connection", patience: float) -> Outcome:
    """Send a case and wait for its answers."""
    try:
        pipe.send(case)
        if not pipe.poll(patience):
            return Outcome(case, "hang")
        kind, text = pipe.recv()
        if kind == "loaded":
            if not pipe.poll(patience):
                return Outcome(case, "hang", "the comparison")
            _, text = pipe.recv()
            kind = "differs" if text else "loaded"
    except (EOFError, OSError):
        return Outcome(case, "died")
    if kind == "refused" and case.same:
        kind = "refused although nothing changed"
    return Outcome(case, kind, text)


def main() -> None:
    """Run from the command line and print what is not clean."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--count", type=int, default=400, help="0 for all")
    parser.add_argument("--only", default="", help="cases whose name holds this")
    options = parser.parse_args()
    cases = generate(options.seed, options.count) if options.count else all_cases(options.seed)
    outcomes = run([case for case in cases if options.only in case.name])
    for outcome in outcomes:
        if not outcome.clean:
            short = replace(outcome.case, data=b"", original=b"")
            print(f"{outcome.kind}: {short.name}\n    {outcome.text.strip().splitlines()[-1:]}")
    print(dict(Counter((outcome.case.suffix, outcome.kind) for outcome in outcomes)))


if __name__ == "__main__":
    main()
