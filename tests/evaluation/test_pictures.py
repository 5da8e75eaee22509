"""Pictures: 8 bits of an image in [0, 1], in the format of the file's suffix."""

import numpy as np
import pytest
from PIL import Image

from ssplat_jax.evaluation.pictures import save_image


@pytest.mark.parametrize("name", ["a.png", "a.PNG", "a.Jpg"])
def test_an_image_is_written_in_the_format_of_its_suffix(name, tmp_path):
    image = np.tile(np.linspace(0.0, 1.0, 32)[:, None, None], (1, 48, 3))
    save_image(tmp_path / name, image)
    with Image.open(tmp_path / name) as held:
        assert held.format == ("PNG" if name.lower().endswith("png") else "JPEG") and held.size == (48, 32)
        np.testing.assert_allclose(np.asarray(held), 255 * image, atol=0.51 if held.format == "PNG" else 4)
