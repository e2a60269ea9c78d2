"""``closedloop lab`` and ``closedloop export``: refusals, closing, and what the exported files hold."""

import csv
import os
import re
import signal
import socket
import threading
import time
from pathlib import Path

import numpy as np
import pytest
from sweep_runs import Forked

import closedloop as cl
from closedloop.__main__ import main
from closedloop.figures.export.files import write_mcap
from closedloop.lab import server
from closedloop.lab.server import HALF_OPEN, PATIENCE, Server, is_loopback, without_token
from closedloop.lab.start import open_in_browser


@pytest.fixture(scope="module")
def run_file(tmp_path_factory):
    """A short run with events, as a file."""
    run = cl.simulate(cl.load_scenario("planar2_drop", {"time.duration": 0.3}))
    return run.save(tmp_path_factory.mktemp("runs") / "run.nc")


@pytest.mark.parametrize(
    ("words", "said"),
    [
        (["no_such"], "no scenario"),
        (["wam_slide", "--law.force", "x"], "law.force = 'x'"),
        (["wam_slide", "--law", "no_such_module:f"], "no module"),
        (["wam_slide", "--time.step", "0.1"], "time constant at least"),
        (["wam_slide", "--colour"], "unrecognized arguments"),
        (["wam_slide", "--port", "99999999"], "--port 99999999: must be from 1 to 65535"),
        (["wam_slide", "--port", "-1"], "--port -1: must be from 1 to 65535"),
        (["wam_slide", "--host", "300.1.1.1"], "--host 300.1.1.1 --port 8080: cannot listen there"),
    ],
)
def test_a_lab_that_cannot_be_opened_is_one_line(words, said, capsys):
    """The exit status is 2, nothing is served, and the line says what is wrong."""
    pytest.importorskip("websockets", reason="websockets is not installed: the extra 'lab'")
    assert main(["lab", "--no-browser", *words]) == 2
    out, err = capsys.readouterr()
    assert out == ""
    assert len(err.splitlines()) == 1
    assert said in err


def test_without_websockets_the_line_says_what_to_install(monkeypatch, capsys):
    """The extra is named."""
    monkeypatch.setattr("closedloop.command.serve.find_spec", lambda name: None)
    assert main(["lab"]) == 2
    assert 'pip install "closedloop[lab]"' in capsys.readouterr().err


def test_only_loopback_is_without_a_warning():
    """What other computers reach is warned of."""
    assert [is_loopback(host) for host in ("127.0.0.1", "::1", "localhost")] == [True] * 3
    assert [is_loopback(host) for host in ("0.0.0.0", "192.168.1.2", "example.org")] == [False] * 3


TOKEN = "0123456789abcdef"


@pytest.fixture(scope="module")
def served():
    """The port of a server of a page."""
    pytest.importorskip("websockets", reason="websockets is not installed: the extra 'lab'")
    server = Server("127.0.0.1", 8591, TOKEN, lambda nonce: f"<p>{nonce}</p>", lambda client: None,
                    lambda client, said: client.put("said", b"heard"))  # fmt: skip
    yield server.port
    server.close()


def asked_for(served, path, *, socketed=True, origin="http://{}", host="{}", whole=False):
    """Return the head of what the server answers to a request, for its websocket or for a page; or all of it."""
    port = served
    own = f"127.0.0.1:{port}"
    lines = [f"Host: {host.format(own)}"]
    if socketed:
        lines += ["Upgrade: websocket", "Connection: Upgrade", "Sec-WebSocket-Version: 13",
                  "Sec-WebSocket-Key: AAAAAAAAAAAAAAAAAAAAAA=="]  # fmt: skip
    lines += [] if origin is None else [f"Origin: {origin.format(own)}"]
    with socket.create_connection(("127.0.0.1", port), 30.0) as asking:
        asking.sendall("\r\n".join([f"GET {path} HTTP/1.1", *lines, "", ""]).encode())
        head = b""
        while (whole or b"\r\n\r\n" not in head) and (more := asking.recv(4096)):
            head += more
    return (head if whole else head.partition(b"\r\n\r\n")[0]).decode()


@pytest.mark.parametrize(
    ("origin", "host", "let_in"),
    [
        ("http://{}", "{}", True),
        (None, "{}", True),
        ("http://example.org", "{}", False),
        ("null", "{}", False),
        ("http://example.org", "example.org", False),
    ],
)
def test_no_other_page_reaches_the_socket(origin, host, let_in, served):
    """A browser lets any page open it: it is refused by its origin, a name elsewhere that leads here by its host."""
    status = asked_for(served, f"/{TOKEN}", origin=origin, host=host)
    assert status.startswith("HTTP/1.1 101" if let_in else "HTTP/1.1 403")


@pytest.mark.parametrize(
    ("path", "host"),
    [("/", "["), ("/", "[::1"), ("/", "127.0.0.1\r\nHost: x"), ("//[", "{}"), ("/{}", "127.0.0.1:x@[")],
)
def test_a_malformed_request_is_answered_in_one_line(path, host, served):
    """It is the one who asks that is at fault, not the server."""
    status, *_, line = asked_for(served, path, socketed=False, origin=None, host=host, whole=True).splitlines()
    assert status.startswith("HTTP/1.1 400")
    assert "no known form" in line


def test_every_answer_says_what_a_browser_may_do_with_it(served):
    """Nothing is framed, guessed or loaded from elsewhere; only the script that carries the answer's own word runs."""
    nonces = set()
    for path in (f"/{TOKEN}", f"/{TOKEN}", f"/?token={TOKEN}", "/", "//["):
        answer = asked_for(served, path, socketed=False, origin=None, whole=True)
        assert "X-Frame-Options: DENY" in answer
        assert "X-Content-Type-Options: nosniff" in answer
        policy = dict(each.split(" ", 1) for each in re.search("Security-Policy: (.*)\r", answer)[1].split("; "))
        assert policy["default-src"] == policy["frame-ancestors"] == "'none'"
        assert policy["script-src"] == policy["style-src"]
        assert not set(policy["script-src"].split()) & {"'unsafe-inline'", "'unsafe-eval'", "*"}
        nonces.add(nonce := re.fullmatch("'nonce-(.{20,})'", policy["script-src"])[1])
        assert (f"<p>{nonce}</p>" in answer) == (path == f"/{TOKEN}")
    assert len(nonces) == 5


@pytest.mark.parametrize("said", ["{", "[1]", "9" * 5000, "[" * 100_000, '{"do": ' * 50_000], ids=lambda said: said[:5])
def test_what_is_no_request_leaves_the_socket_open(said, served):
    """Also a number of too many digits and lists that are too deep: the page is told so, and goes on."""
    sockets = pytest.importorskip("websockets.sync.client")
    with sockets.connect(f"ws://127.0.0.1:{served}/{TOKEN}", compression=None) as page:
        for text in (said, '{"do": "x"}'):
            page.send(text)
            assert page.recv(30.0) == b"heard"


def test_clients_are_bounded_in_number_and_in_time(served, monkeypatch):
    """Sockets that ask for nothing give way to newer ones; of pages that are open there are so many at most."""
    sockets = pytest.importorskip("websockets.sync.client")
    silent = [socket.create_connection(("127.0.0.1", served), 30.0) for _ in range(60)]
    assert asked_for(served, f"/{TOKEN}", socketed=False, origin=None).startswith("HTTP/1.1 200")
    assert [each.recv(1) for each in silent[: 60 - HALF_OPEN]] == (60 - HALF_OPEN) * [b""]
    assert threading.active_count() < 2 * HALF_OPEN + 20
    for each in silent:
        each.close()
    monkeypatch.setattr("closedloop.lab.server.PAGES", 2)
    url = f"ws://127.0.0.1:{served}/{TOKEN}"
    with sockets.connect(url) as one, sockets.connect(url) as other:
        for page in (one, other):
            page.send("{}")
            page.recv(30.0)
        answer = asked_for(served, f"/{TOKEN}", socketed=False, origin=None, whole=True)
        assert answer.startswith("HTTP/1.1 503")
        assert answer.endswith("2 pages of the lab are open, and no more may be: close one\n")
        assert asked_for(served, f"/{TOKEN}").startswith("HTTP/1.1 503")
    for _ in range(100):  # until the server knows that they are gone
        if (status := asked_for(served, f"/{TOKEN}", socketed=False, origin=None)).startswith("HTTP/1.1 200"):
            break
        time.sleep(0.1)
    assert status.startswith("HTTP/1.1 200")


@pytest.mark.slow
def test_a_socket_that_asks_for_nothing_is_closed_in_time(served):
    """A part of a request is none."""
    with socket.create_connection(("127.0.0.1", served), 30.0) as asking:
        asking.sendall(b"GET / HTTP/1.1\r\n")
        began = time.monotonic()
        assert asking.recv(1) == b""
        assert time.monotonic() - began < PATIENCE + 5.0


@pytest.mark.parametrize("socketed", [True, False], ids=["websocket", "page"])
@pytest.mark.parametrize(
    "path",
    [
        "/", "/index.html", f"/{TOKEN[:-1]}", f"/{TOKEN}0", f"/x/{TOKEN}", "/?token=", f"/?token={TOKEN[1:]}",
        "/?token=%C3%A9",
    ],
)  # fmt: skip
def test_who_does_not_name_the_token_gets_nothing(path, socketed, served):
    """Another user of this computer reaches the port, and neither the page nor its socket."""
    assert asked_for(served, path, socketed=socketed, origin=None).startswith("HTTP/1.1 403")


def test_the_address_leads_to_the_page_and_its_socket(served):
    """The address that is printed sends the page on to one below which it opens its socket; nothing tells it on."""
    sent_on = asked_for(served, f"/?token={TOKEN}", socketed=False, origin=None)
    assert sent_on.startswith("HTTP/1.1 302")
    assert f"Location: ./{TOKEN}" in sent_on
    page = asked_for(served, f"/{TOKEN}", socketed=False, origin=None)
    assert page.startswith("HTTP/1.1 200")
    assert "text/html" in page
    assert "Referrer-Policy: no-referrer" in page
    for path in (f"/{TOKEN}", f"/?token={TOKEN}"):
        assert asked_for(served, path).startswith("HTTP/1.1 101")
    assert without_token(f"/{TOKEN}/any/file?x=1", TOKEN) == "/any/file"


def test_a_notebook_behind_jupyters_server_has_the_address_below_it(monkeypatch):
    """With jupyter-server-proxy the frame's address is a path below the hub's; the hub's name is let in then."""
    monkeypatch.setenv("JUPYTERHUB_SERVICE_PREFIX", "/user/x/")
    monkeypatch.setattr(server, "find_spec", lambda name: None)
    assert server.proxied(8080) == ""
    monkeypatch.setattr(server, "find_spec", lambda name: object())
    assert server.proxied(8080) == "/user/x/proxy/8080/"
    pytest.importorskip("websockets", reason="websockets is not installed: the extra 'lab'")
    for framed, answer in ((True, "101"), (False, "403")):
        framing = Server("127.0.0.1", 8595, TOKEN, str, lambda client: None, lambda client, said: None, framed=framed)
        said = asked_for(framing.port, f"/{TOKEN}", host="hub.example.org", origin="http://hub.example.org")
        assert said.startswith(f"HTTP/1.1 {answer}")
        framing.close()


def test_the_browser_is_given_no_token_on_its_command_line(monkeypatch):
    """Other users see the words of a command line: they name a file of this user's, which has the address."""
    opened = []
    monkeypatch.setattr("webbrowser.open", opened.append)
    open_in_browser(f"http://127.0.0.1:8080/?token={TOKEN}")
    (uri,) = opened
    assert TOKEN not in uri
    page = Path(uri.removeprefix("file://"))
    assert f"url=http://127.0.0.1:8080/?token={TOKEN}" in page.read_text()
    assert os.name != "posix" or page.parent.stat().st_mode & 0o077 == 0


@pytest.mark.slow
def test_ctrl_c_closes_the_lab_without_a_traceback(tmp_path):
    """The address is printed, the page is on this computer alone, and Ctrl-C ends it with status 0."""
    sockets = pytest.importorskip("websockets.sync.client", reason="websockets is not installed: the extra 'lab'")
    with Forked(tmp_path, "lab", "planar2_slide", "--port", "8431", "--no-browser", command=main) as process:
        line = process.readline()
        assert "http://127.0.0.1:84" in line
        assert "/?token=" in line
        url = re.search(r"http\S+", line)[0]
        with sockets.connect(url.replace("http", "ws", 1), compression=None):  # a page that is open keeps nothing
            process.send_signal(signal.SIGINT)
            _, err = process.communicate(timeout=60)
    assert process.returncode == 0
    assert "Traceback" not in err
    assert "the lab is closed" in err


def test_csv_has_units_and_every_digit(run_file, tmp_path):
    """The numbers are read back to the bit, and the events stand in a file of their own."""
    assert main(["export", str(run_file), "--to", "csv", "--out", str(tmp_path / "drop.csv")]) == 0
    run = cl.load_run(run_file)
    with (tmp_path / "drop.csv").open(newline="") as file:
        header, *rows = csv.reader(file)
    assert len(rows) == len(run)
    for name, values in (
        ("time [s]", run.time), ("contact_force [N]", run.contact_force), ("position z [m]", run.position[:, 2]),
        (f"q {run.model.joint_names[1]} [rad]", run.q[:, 1]), ("mode", run.mode),
    ):  # fmt: skip
        assert np.array_equal([float(row[header.index(name)]) for row in rows], values), name
    with (tmp_path / "drop_events.csv").open(newline="") as file:
        events = list(csv.DictReader(file))
    assert [event["event_kind"] for event in events] == [event.kind for event in run.events]
    assert [float(event["event_time [s]"]) for event in events] == run.event_time.tolist()


def test_mcap_has_the_joints_the_tip_and_the_events(run_file, tmp_path):
    """A reader of ROS 2 messages gets the run's numbers at the run's times."""
    reader = pytest.importorskip("mcap_ros2.reader", reason="mcap-ros2-support is not installed: the extra 'mcap'")
    run, file = cl.load_run(run_file), tmp_path / "drop.mcap"
    assert main(["export", str(run_file), "--to", "mcap", "--out", str(file)]) == 0
    found = {}
    for message in reader.read_ros2_messages(str(file)):
        found.setdefault(message.channel.topic, []).append(message)
    assert len(found["/joint_states"]) == len(found["/tip_pose"]) == len(run)
    last = found["/joint_states"][-1]
    assert last.ros_msg.position == run.q[-1].tolist()
    assert last.ros_msg.effort == run.torque[-1].tolist()
    assert last.log_time_ns == round(1e9 * run.time[-1])
    place = found["/tip_pose"][7].ros_msg.pose.position
    assert [place.x, place.y, place.z] == run.position[7].tolist()
    force = found["/tip_wrench"][-1].ros_msg.wrench.force
    assert force.z == pytest.approx(run.contact_force[-1] + run.friction_force[-1, 2])
    assert [m.ros_msg.msg.partition(":")[0] for m in found["/events"]] == [event.kind for event in run.events]
    asked = found["/commanded_wrench"][-1].ros_msg.wrench.force
    assert [asked.x, asked.y, asked.z] == (run.reference_force[-1] * run.surface_normal[-1]).tolist()
    assert asked.z > 0.0
    point = found["/desired_position"][7].ros_msg.point
    assert [point.x, point.y, point.z] == run.reference_tip[7].tolist()
    (path,) = found["/desired_path"]
    ends = [path.ros_msg.poses[k].pose.position for k in (0, -1)]
    assert [[p.x, p.y, p.z] for p in ends] == run.reference_tip[[0, -1]].tolist()


def test_mcap_of_bodies_without_a_law_has_no_path_and_no_command(tmp_path):
    """Nothing is wanted of a cube that is thrown."""
    reader = pytest.importorskip("mcap_ros2.reader", reason="mcap-ros2-support is not installed: the extra 'mcap'")
    (file,) = write_mcap(cl.simulate(cl.load_scenario("cube_toss", {"time.duration": 0.01})), tmp_path / "cube.mcap")
    topics = {message.channel.topic for message in reader.read_ros2_messages(str(file))}
    assert "/tip_pose" in topics
    assert not topics & {"/commanded_wrench", "/desired_position", "/desired_path"}
    assert not any(topic.startswith("/contacts/") for topic in topics)  # it has not come down yet


def test_mcap_has_the_forces_between_links(tmp_path):
    """Along the normal and across it they are the run's: two hands press on a bar, whose planes turn with the arms."""
    reader = pytest.importorskip("mcap_ros2.reader", reason="mcap-ros2-support is not installed: the extra 'mcap'")
    run = cl.simulate(cl.load_scenario("two_arms_bar", {"time.duration": 0.02}))
    (file,) = write_mcap(run, tmp_path / "bar.mcap")
    found = {}
    for message in reader.read_ros2_messages(str(file)):
        found.setdefault(message.channel.topic, []).append(message.ros_msg)
    topics = [topic for topic in found if topic.startswith("/contacts/")]
    assert len(topics) == run.link_forces.shape[1] > 1
    for i, topic in enumerate(topics):
        force = np.array([[m.wrench.force.x, m.wrench.force.y, m.wrench.force.z] for m in found[topic]])
        size = np.hypot(run.link_forces[:, i], np.hypot(*run.link_frictions[:, 2 * i : 2 * i + 2].T))
        np.testing.assert_allclose(np.linalg.norm(force, axis=1), size, rtol=1e-12, atol=1e-12)
    assert np.max(size) > 1.0


def test_films_pages_and_bags_are_exports_too(run_file, tmp_path, capsys):
    """Each is written beside the run under its name; --help lists all formats."""
    (tmp_path / "x.nc").write_bytes(run_file.read_bytes())
    for to in ("gif", "html", "h5"):
        assert main(["export", str(tmp_path / "x.nc"), "--to", to]) == 0
    assert (tmp_path / "x.gif").read_bytes()[:3] == b"GIF"
    assert "<canvas" in (tmp_path / "x.html").read_text(encoding="utf-8")
    assert cl.load_run(tmp_path / "x.h5").scenario == cl.load_run(run_file).scenario
    capsys.readouterr()
    main(["export", "--help"])
    assert "{csv,mat,mcap,parquet,h5,rosbag2,mjcf,gif,mp4,html}" in capsys.readouterr().out


def test_an_export_replaces_nothing_unasked(run_file, tmp_path, capsys):
    """A file that is there is refused, and no format but those known is taken."""
    out = tmp_path / "drop.csv"
    out.write_text("mine")
    assert main(["export", str(run_file), "--to", "csv", "--out", str(out)]) == 2
    assert "--overwrite" in capsys.readouterr().err
    assert out.read_text() == "mine"
    assert main(["export", str(run_file), "--to", "xls"]) == 2
    assert main(["export", str(tmp_path / "none.nc"), "--to", "csv"]) == 2
    assert len(capsys.readouterr().err.splitlines()) == 2
