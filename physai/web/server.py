"""The page: a viser server that listens where it is told to, and ends with whoever started it."""

import contextlib
import io
import socket
from collections.abc import Iterator

import viser

from physai.errors import UserError
from physai.web.door import Door, guarding

Point = tuple[float, float, float]

CELL = 0.1  # m, of the grid on the floor


def camera(reach: float) -> tuple[Point, Point]:
    """Where the camera is that sees a robot, and where it looks, m.

    Args:
        reach: Length of the stretched robot, m.
    """
    return (1.0 * reach, -1.5 * reach, 1.4 * reach), (0.0, 0.0, 0.25 * reach)


class Server(viser.ViserServer):
    """A server whose scene has a floor."""

    floor: viser.GridHandle

    def request_share_url(self, verbose: bool = True) -> None:
        """Refuse what any client can ask viser for: a tunnel that shows the page to the internet."""


@contextlib.contextmanager
def serve(
    host: str, port: int, label: str, reach: float, floor: float = 0.0, door: Door | None = None
) -> Iterator[Server]:
    """Context with a server, whose scene has a floor, and a camera for robots of a size.

    Args:
        host: An address of this computer; ``127.0.0.1`` is for its own browsers only.
        port: Where to listen; 0 takes a free one.
        label: Title of the page.
        reach: Length of the stretched robot, m.
        floor: Its height, m.
        door: Who gets in; None lets everyone who can reach the page, but no page of others.

    Raises:
        UserError: If it cannot listen there.
    """
    with socket.socket() as probe:  # viser would silently take the next port that is free
        probe.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
        try:
            probe.bind((host, port))
        except (OSError, OverflowError) as error:
            reason = getattr(error, "strerror", None) or error
            raise UserError(f"cannot listen on {host}, port {port}: {reason}") from error
        port = probe.getsockname()[1]
    keeper = guarding(door or Door(host, commands=True))
    with contextlib.redirect_stdout(io.StringIO()), keeper:  # it prints its address in a frame
        server = Server(host=host, port=port, label=label, verbose=False)
    server.gui.configure_theme(control_layout="fixed", show_logo=False, show_share_button=False)
    # Surroundings to reflect take a browser without a GPU 10 s of processor time, which nodes beside it may need.
    server.scene.configure_environment_map(None)
    server.scene.add_light_hemisphere("/sky", ground_color=(190, 190, 200), intensity=2.5)
    size, place = 4 * reach, (0.0, 0.0, floor)
    server.floor = server.scene.add_grid("/floor", width=size, height=size, position=place, cell_size=CELL)
    server.initial_camera.position, server.initial_camera.look_at = camera(reach)
    try:
        yield server
    finally:
        with contextlib.redirect_stdout(io.StringIO()):
            server.stop()
