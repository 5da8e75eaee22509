"""The panel of a browser: its controls, and what the person chose with them.

Callbacks of viser run on threads of its own. They only store what was chosen; the viewer's loop acts on it.
"""

from typing import Any

from ssplat_jax.viewer.drawn_view import KINDS

SPLATS = "splats"
"""The choice of what to show that the browser draws itself."""


class Panel:
    """Controls of one browser.

    Args:
        client: viser's handle of the browser.
    """

    def __init__(self, client: Any) -> None:
        gui = client.gui
        gui.set_panel_label("ssplat")
        self._facts = gui.add_markdown("")
        self._kind = gui.add_dropdown(
            "Show",
            (SPLATS, *KINDS),
            initial_value=SPLATS,
            hint="All but splats are drawn by ssplat's rasterizer at this window's camera.",
        )
        self._chunk = gui.add_slider("Chunk", 1, 2, 1, 1, visible=False, hint="The scene after so many chunks.")
        self._cameras = gui.add_checkbox(
            "Cameras", False, hint="Streamed cameras with their images; click on one to go there."
        )
        self.play = gui.add_button_group("Play", ("orbit", "path", "stop"))
        self.screenshot = gui.add_button("Screenshot")
        self.download = gui.add_button("Download scene")
        self.figures = gui.add_folder("Figures", visible=False)
        self._num_chunks = 0

    @property
    def kind(self) -> str:
        """The choice of what to show."""
        return self._kind.value

    @property
    def shows_cameras(self) -> bool:
        """True if streamed cameras are wanted."""
        return self._cameras.value

    @property
    def num_chunks(self) -> int | None:
        """The chunks after which the scene is wanted; None for the newest scene, also when more chunks come."""
        return None if self._num_chunks < 2 or self._chunk.value >= self._num_chunks else int(self._chunk.value)

    def grow(self, num_chunks: int) -> None:
        """Lets the slider reach `num_chunks`; at its end, it stays there."""
        if num_chunks == self._num_chunks:
            return
        is_at_end = self.num_chunks is None
        self._num_chunks = num_chunks
        self._chunk.visible = num_chunks > 1
        self._chunk.max = max(num_chunks, 2)
        if is_at_end or self._chunk.value > num_chunks:
            self._chunk.value = max(num_chunks, 1)

    def tell(self, facts: str) -> None:
        """Writes a line at the top."""
        if self._facts.content != facts:
            self._facts.content = facts
