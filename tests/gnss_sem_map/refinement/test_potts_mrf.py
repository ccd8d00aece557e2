"""Mean-field smoothing against a loop over a dict of voxels."""

import itertools

import numpy as np
from hypothesis import given, settings
from hypothesis import strategies as st

from gnss_sem_map.refinement.potts_mrf import PottsSettings, mean_field
from gnss_sem_map.voxels.voxel_map import pack

COUPLING_NAT = PottsSettings().coupling_nat


def by_hand(indices, scores, observed, coupling, temper, iterations):
    """The same, voxel by voxel, in double precision."""
    place = {tuple(v): i for i, v in enumerate(indices.tolist()) if observed[i]}
    own = temper * scores.astype(np.float64)

    def softmax(u):
        e = np.exp(u - u.max())
        return e / e.sum()

    q = {i: softmax(own[i]) for i in place.values()}
    offsets = [o for o in itertools.product((-1, 0, 1), repeat=3) if o != (0, 0, 0)]
    for _ in range(iterations):
        q = {
            i: softmax(
                own[i]
                + coupling
                * sum(
                    (q[place[n]] for o in offsets if (n := tuple(np.add(v, o))) in place),
                    np.zeros(len(own[i])),
                )
            )
            for v, i in place.items()
        }
    return q


@settings(max_examples=40, deadline=None)
@given(
    seed=st.integers(0, 2**32 - 1),
    temper=st.sampled_from([0.1, 0.3, 1.0]),
    coupling=st.sampled_from([0.0, 0.2, 0.5]),
    iterations=st.integers(1, 5),
)
def test_every_voxel_hears_its_26_neighbours_and_no_other(seed, temper, coupling, iterations):
    rng = np.random.default_rng(seed)
    indices = np.unique(rng.integers(-3, 3, (80, 3)), axis=0)
    scores = rng.normal(0, 3, (len(indices), 4)).astype(np.float32)
    observed = rng.random(len(indices)) < 0.8
    refined = mean_field(pack(indices), scores, observed, coupling, temper, iterations)
    for i, q in by_hand(indices, scores, observed, coupling, temper, iterations).items():
        np.testing.assert_allclose(np.exp(refined[i]), q, atol=1e-4)
    np.testing.assert_array_equal(refined[~observed], scores[~observed])


def test_a_lone_wrong_voxel_in_a_wall_gives_in_and_a_sure_one_does_not():
    wall = np.array([(x, 0, z) for x in range(9) for z in range(9)])
    scores = np.tile(np.array([0.0, -4.0], np.float32), (81, 1))
    scores[40] = -2.0, 0.0
    assert (mean_field(pack(wall), scores, np.ones(81, bool), COUPLING_NAT).argmax(1) == 0).all()
    scores[40] = -20.0, 0.0
    assert mean_field(pack(wall), scores, np.ones(81, bool), COUPLING_NAT)[40].argmax() == 1


def test_a_map_that_no_camera_saw_stays_as_it_is():
    scores = np.zeros((2, 3), np.float32)
    keys = pack(np.array([(0, 0, 0), (0, 0, 1)]))
    assert mean_field(keys, scores, np.zeros(2, bool), COUPLING_NAT) is scores
