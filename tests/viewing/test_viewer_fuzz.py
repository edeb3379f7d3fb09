"""The live viewer's socket, attacked: whatever a client sends, nothing is printed, others are served, nothing stops."""

import random
from contextlib import closing, suppress
from socket import SHUT_WR, create_connection
from typing import Any

import pytest
from fuzzing import SEED, mutated_bytes, mutated_value

from d2_plugin.viewing.live import Viewer
from d2_plugin.viewing.live.server import COOKIE
from d2_plugin.viewing.viewed import ViewedRun

viser = pytest.importorskip("viser", reason="viser is in the `view` extra")
msgpack = pytest.importorskip("msgspec").msgpack
ConnectionClosed = pytest.importorskip("websockets.exceptions").ConnectionClosed

CAMERA = {
    "type": "ViewerCameraMessage",
    "wxyz": [1.0, 0.0, 0.0, 0.0],
    "position": [0.0, 0.0, -1.0],
    "fov": 0.8,
    "near": 0.01,
    "far": 1000.0,
    "image_height": 300,
    "image_width": 400,
    "look_at": [0.0, 0.0, 1.0],
    "up_direction": [0.0, -1.0, 0.0],
}


def connected(viewer: Viewer) -> Any:
    """A client's socket, behind its first camera message."""
    from websockets.sync.client import connect

    address, _, token = viewer.url.partition("/?token=")
    headers = {"Cookie": f"{COOKIE}={token}"}
    protocol = f"viser-v{viser.__version__}"
    socket = connect(address.replace("http", "ws"), origin=address, additional_headers=headers,
                     subprotocols=[protocol], compression=None, max_size=None, max_queue=None)  # fmt: skip
    socket.send(msgpack.encode(CAMERA))
    return socket


def showing(viewed: ViewedRun) -> closing[Viewer]:
    """A viewer that draws while a test lets it `stay`, as `d2 view` does for good."""
    return closing(Viewer(viewed=viewed, port=18080, height=48))


def drawn(viewer: Viewer, count: int) -> None:
    """Draw until that many pages have their first image."""
    viewer.stay(lambda: [page.drawn is not None for page, _ in viewer._pages.values()] == [True] * count)


def messages_of(viewer: Viewer) -> list[dict[str, Any]]:
    """Everything that a page can send, and what viser has besides."""
    from viser import _messages

    page, _ = list(viewer._pages.values())[-1]
    updates = [
        {"type": "GuiUpdateMessage", "uuid": uuid, "updates": {"value": control._impl.value}}
        for uuid, control in page.client.gui._gui_input_handle_from_uuid.items()
    ]
    kinds = [kind for kind in _messages.Message.get_subclasses() if hasattr(kind, "__dataclass_fields__")]
    known = [{"type": kind.__name__, **dict.fromkeys(kind.__dataclass_fields__, "")} for kind in kinds]
    return [CAMERA] * len(known) + updates * 3 + known


def test_only_what_the_page_sends_comes_in(viewed: ViewedRun, monkeypatch: pytest.MonkeyPatch) -> None:
    shared: list[object] = []
    monkeypatch.setattr(viser.ViserServer, "request_share_url", lambda self: shared.append(self))
    with showing(viewed) as viewer, connected(viewer) as socket:
        drawn(viewer, 1)
        [(page, _)] = viewer._pages.values()
        control = page.controls["recorded"]
        update = {"type": "GuiUpdateMessage", "uuid": control._impl.uuid}
        socket.send(msgpack.encode({"type": "ShareUrlRequest"}))
        for changed in ({"max": 5.0, "value": 0.2}, {"update_cb": [1]}, {"value": 0.5}):
            socket.send(msgpack.encode({**update, "updates": changed}))
        viewer.stay(lambda: control.value == 0.5)
        assert control.max == 1.0
        assert not shared, "a page is not brought to the internet because a client asks for it"


@pytest.mark.parametrize(("count", "seed"), [(200, 0), pytest.param(10_000, SEED, marks=pytest.mark.slow)])
def test_messages_at_random(viewed: ViewedRun, count: int, seed: int, capfd, caplog, recwarn) -> None:
    with showing(viewed) as viewer, connected(viewer) as looker:
        drawn(viewer, 1)
        for round in range(count // 50):
            attacker = connected(viewer)
            drawn(viewer, 2)
            own = messages_of(viewer)
            for number in range(50):
                rng = random.Random(f"message {seed} {round} {number}")
                with suppress(OverflowError):
                    data = msgpack.encode(mutated_value(rng.choice(own), rng))
                    data = data if rng.random() < 0.8 else mutated_bytes(data, rng)
                    try:
                        attacker.send(data)
                    except ConnectionClosed:
                        attacker = connected(viewer)
            attacker.close()
            with suppress(ConnectionError), create_connection(looker.remote_address[:2]) as raw:
                raw.sendall(rng.randbytes(200))
                raw.shutdown(SHUT_WR)
                while raw.recv(1000):
                    pass
            drawn(viewer, 1)
        looker.send(msgpack.encode(CAMERA | {"position": [0.0, 0.0, -2.0]}))
        viewer.stay(lambda: any(page.last and page.last.pose[:3] == (0, 0, -2) for page, _ in viewer._pages.values()))
    said = capfd.readouterr()
    assert "Traceback" not in said.err + said.out + caplog.text, (said, caplog.text)
    assert "Task" not in said.err + said.out, said
    assert "is not drawn any more" not in caplog.text, caplog.text
    assert not [said for said in recwarn if "viser" in str(said.message)], "what a client sent is printed"


def test_keyframes_come_and_go_while_the_path_is_asked_for(viewed: ViewedRun, capfd) -> None:
    with showing(viewed) as viewer, connected(viewer) as socket:
        drawn(viewer, 1)
        [(page, _)] = viewer._pages.values()
        buttons = {control.label: uuid for uuid, control in page.client.gui._gui_input_handle_from_uuid.items()}
        press = {"type": "GuiUpdateMessage", "updates": {"value": True}}
        clicks = ["Add keyframe"] * 5 + ["Save camera_path.json", "Preview", "Remove the last", "Add keyframe"] * 5
        for label in clicks:
            socket.send(msgpack.encode(press | {"uuid": buttons[label]}))
        viewer.stay(lambda: len(page.keyframes) == 5 and page._previewed is not None)
    said = capfd.readouterr()
    assert "Traceback" not in said.err + said.out, said
