"""A town to drive through: streets, houses, trees, traffic, and the sensors of a recording vehicle."""

from gnss_sem_map.simulation.drive import Simulation as Simulation
from gnss_sem_map.simulation.drive import prepare as prepare
from gnss_sem_map.simulation.drive import simulate as simulate
