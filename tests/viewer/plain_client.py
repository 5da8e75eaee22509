"""A client of viser that draws nothing: `python -m tests.viewer.plain_client URL reads|stalls FILE`.

It says where it looks from, as a browser does, and then reads what comes and writes the number of bytes to a file; one
that stalls reads nothing after its first message.
"""

import sys
import time
from pathlib import Path

WINDOW = (1280, 720)


def main(url: str, way: str, file: str) -> None:
    """Connects to a viewer and stays until it is killed or the viewer ends."""
    import msgspec.msgpack
    import viser
    from viser._messages import ViewerCameraMessage
    from websockets.exceptions import ConnectionClosed
    from websockets.sync.client import connect
    from websockets.typing import Subprotocol

    camera = ViewerCameraMessage(
        wxyz=(1.0, 0.0, 0.0, 0.0),
        position=(0.0, 0.0, 0.0),
        fov=1.3,
        near=0.01,
        far=1000.0,
        image_height=WINDOW[1],
        image_width=WINDOW[0],
        look_at=(0.0, 0.0, 1.0),
        up_direction=(0.0, -1.0, 0.0),
    )
    protocol = Subprotocol(f"viser-v{viser.__version__}")
    with connect(url.replace("http", "ws", 1), subprotocols=[protocol], max_size=None, ping_interval=None) as socket:
        socket.recv()
        socket.send(msgspec.msgpack.encode(camera.as_serializable_dict()))
        if way == "stalls":
            Path(file).write_text("0")
            time.sleep(1e6)
        num_bytes = 0
        try:
            while True:
                num_bytes += len(socket.recv())
                Path(file).write_text(str(num_bytes))
        except ConnectionClosed:
            pass


if __name__ == "__main__":
    main(*sys.argv[1:])
