"""Who gets in, and who may command: by a real server, and clients that lie."""

import urllib.error
import urllib.request

import pytest
import viser
from viser import _messages
from websockets.exceptions import InvalidStatus

from physai.web.door import Door, commander, guarding
from physai.web.server import serve
from tests.waiting import wait_for
from tests.web.visitor import Visitor

HERE, TOKEN = "127.0.0.2", "of-those-who-may-command"


@pytest.mark.parametrize(
    ("listening", "host", "origin", "refused"),
    [
        ("127.0.0.1", "127.0.0.1:80", "http://127.0.0.1:80", None),
        ("127.0.0.1", "localhost:9000", "http://localhost:9000", None),  # through a tunnel
        ("127.0.0.1", "127.0.0.1:80", None, None),  # no WebSocket
        ("127.0.0.1", "127.0.0.1:80", "http://evil.example", "by this page itself"),
        ("127.0.0.1", "127.0.0.1:80", "http://127.0.0.1:81", "by this page itself"),
        ("127.0.0.1", "127.0.0.1:80", "", "by this page itself"),
        ("127.0.0.1", "127.0.0.1:80", "null", "by this page itself"),
        ("127.0.0.1", "evil.example:80", "http://evil.example:80", "another name"),  # a name that leads here
        ("127.0.0.1", "192.0.2.1:80", "http://192.0.2.1:80", "another name"),
        ("127.0.0.1", "", "http://", "another name"),
        ("0.0.0.0", "192.0.2.1:80", "http://192.0.2.1:80", None),
        ("0.0.0.0", "evil.example:80", "http://evil.example:80", "another name"),
    ],
)
def test_a_page_is_asked_for_by_its_name_and_by_itself(listening, host, origin, refused):
    reason = Door(listening, True).refusal(host, origin)
    assert (reason is None) if refused is None else (reason is not None and refused in reason)


def test_nobody_commands_where_nobody_may_and_elsewhere_who_has_the_token():
    own, other = f"physai_token_8080={TOKEN}", f"physai_token_8081={TOKEN}"
    assert Door("127.0.0.1", True).may_command("127.0.0.1:8080", "")
    assert not Door("127.0.0.1", False).may_command("127.0.0.1:8080", own)
    door = Door(HERE, True, TOKEN)
    assert door.may_command(f"{HERE}:8080", f"a=b; {own}")
    for cookie in ("", other, own[:-1], own + "x", "physai_token_8080=", "physai_token_8080", "\0", '"'):
        assert not door.may_command(f"{HERE}:8080", cookie)


@pytest.fixture
def page():
    """A page beyond localhost, with a button, something to drag, and what may be commanded through them."""
    heard: list[str] = []
    with serve(HERE, 0, "guarded", 1.0, door=Door(HERE, True, TOKEN)) as server:
        button, handle = server.gui.add_button("Go"), server.scene.add_transform_controls("/goal")

        async def press(_: viser.GuiEvent) -> None:
            heard.append("button" if commander() else "button, by nobody")

        async def drag(event: viser.TransformControlsEvent) -> None:
            if event.phase == "end":
                heard.append("drag" if commander() else "drag, by nobody")

        button.on_click(press)
        handle.on_update(drag)
        yield server.get_port(), button._impl.uuid, button, heard


def test_who_has_no_token_watches_and_whatever_they_send_changes_nothing(page):
    port, uuid, button, heard = page
    watcher = Visitor(HERE, port)
    watcher.press(uuid)
    watcher.drag("/goal", (1.0, 0.0, 0.0))
    watcher.say(_messages.GuiUpdateMessage(uuid, {"removed": True}))  # viser itself would obey
    owner = Visitor(HERE, port, cookie=f"physai_token_{port}={TOKEN}")
    for nonsense in ("text", b"", b"\xc1", b"\x81\xa4type\xa7Unknown", b"\x93\x01\x02\x03", bytes(1000)):
        owner.socket.send(nonsense)
    owner.say(_messages.GuiUpdateMessage(uuid, {"removed": True}))
    owner.press(uuid)
    wait_for(lambda: heard)
    assert heard == ["button"]
    assert not button._impl.removed
    # Whose connection ends in the middle of a drag has let nothing go.
    owner.drag("/goal", (0.5, 0.0, 0.0), release=False)
    owner.close()
    wait_for(lambda: len(heard) > 1)
    assert heard[1:] == ["drag, by nobody"]
    watcher.close()


def test_the_token_in_the_address_becomes_a_cookie_and_no_page_frames_this_one(page):
    port = page[0]

    class Stay(urllib.request.HTTPRedirectHandler):
        def redirect_request(self, *args):
            return None

    opener = urllib.request.build_opener(Stay)
    with pytest.raises(urllib.error.HTTPError) as moved:
        opener.open(f"http://{HERE}:{port}/?token={TOKEN}")
    assert (moved.value.code, moved.value.headers["Location"]) == (303, "/")
    cookie = moved.value.headers["Set-Cookie"]
    assert cookie == f"physai_token_{port}={TOKEN}; HttpOnly; SameSite=Strict; Path=/"
    with opener.open(f"http://{HERE}:{port}/?token=wrong") as answer:
        assert "Set-Cookie" not in answer.headers
        assert answer.headers["Content-Security-Policy"] == "frame-ancestors 'none'"


@pytest.mark.parametrize("origin", ["http://evil.example", "http://127.0.0.1:1", "null"])
def test_another_page_cannot_open_a_connection_not_even_with_the_token(page, origin):
    port = page[0]
    with pytest.raises(InvalidStatus, match="403"):
        Visitor(HERE, port, origin, f"physai_token_{port}={TOKEN}")


def test_no_more_browsers_get_in_than_can_be_served(page):
    visitors = [Visitor(HERE, page[0]) for _ in range(16)]
    with pytest.raises(InvalidStatus, match="503"):
        Visitor(HERE, page[0])
    visitors.pop().close()
    wait_for(lambda: _gets_in(page[0], visitors))
    for visitor in visitors:
        visitor.close()


def _gets_in(port: int, visitors: list[Visitor]) -> bool:
    try:
        visitors.append(Visitor(HERE, port))
    except InvalidStatus:
        return False
    return True


def test_a_viser_that_serves_in_another_way_is_found_out():
    with pytest.raises(RuntimeError, match="nobody is kept out"), guarding(Door(HERE, True)):
        pass


def test_a_page_without_a_door_of_its_own_is_for_everyone_here_but_for_no_page_of_others():
    with serve("127.0.0.1", 0, "open", 1.0) as server:
        Visitor("127.0.0.1", server.get_port()).close()
        with pytest.raises(InvalidStatus, match="403"):
            Visitor("127.0.0.1", server.get_port(), "http://evil.example")
