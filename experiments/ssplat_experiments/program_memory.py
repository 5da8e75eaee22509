"""`make_room`: drops compiled programs, of kept sessions too, before a long experiment holds too many of them."""

from ssplat_experiments import joint_network, warm_sessions
from ssplat_jax.core import program_memory
from ssplat_jax.core.cpu_backend import MOST_MAPS


def make_room(most_maps: int = MOST_MAPS) -> None:
    """`ssplat_jax.core.cpu_backend.make_room`, which first forgets the sessions and networks that experiments keep.

    Measurements are warm in any case.
    """
    if program_memory.holds_many_programs(most_maps):
        warm_sessions.forget()
        joint_network.forget()
        program_memory.drop_programs()
