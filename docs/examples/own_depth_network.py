"""Registers a depth network of one's own: the compact one with another matcher, and streams with it."""

import dataclasses
from typing import ClassVar

import jax
import jax.numpy as jnp

import ssplat_jax as ss
from ssplat_jax.model.compact import CompactNetwork
from ssplat_jax.model.network import register_network
from ssplat_jax.network_configs import CompactConfig


@dataclasses.dataclass(frozen=True)
class SharpConfig(CompactConfig):
    """The compact network's configuration under another name, with a field of its own."""

    kind: ClassVar[str] = "sharp"
    sharpness: float = 2.0


class SharpNetwork(CompactNetwork):
    """The compact network with a narrower distribution over depth.

    Override encode, match, regress_tokens, mix_tokens or read_shapes; and `stages`, if shapes change.
    """

    @staticmethod
    def match(params, features, views, config):
        belief = CompactNetwork.match(params, features, views, config)
        logits = belief.logits * config.network.sharpness
        return dataclasses.replace(belief, logits=logits, probs=jax.nn.softmax(logits, axis=-1))


def main() -> float:
    """Streams one chunk and returns the mean confidence of its tokens."""
    register_network(SharpConfig, SharpNetwork())
    model = ss.StreamSplat(ss.preset("tiny").replace(network="sharp"))
    params = ss.load_params("tiny")  # the stages have the same shapes
    chunk = next(iter(ss.open_capture("procedural:room?frames=4&size=64x48").chunks(model.config)))
    _, out = jax.jit(model.step)(params, model.init_cache(), chunk)
    confidence = float(jnp.mean(out.confidences))
    print(f"mean confidence {confidence:.2f}")
    return confidence


if __name__ == "__main__":
    main()
