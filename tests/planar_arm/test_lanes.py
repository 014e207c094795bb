"""Divisions of the elastic limits against muscles of as many parts."""

from dataclasses import replace

import numpy as np

from armperturb.cohort import average_person
from armperturb.environment import Environment
from armperturb.planar_arm.lanes import divisions, lane_table

PERSON = average_person().subjects["RT"]
WIDE_AND_GROWING = ({"elastic_limit_spread": 0.9}, {"elastic_limit_spread": 0.3, "elastic_limit_slope": 0.02})


def test_limits_of_all_divisions_are_those_of_as_many_parts():
    def people(parts):
        wide, growing = (replace(PERSON.muscle, parts=parts, **law) for law in WIDE_AND_GROWING)
        return [replace(PERSON, muscle=law) for law in (wide, growing, replace(wide, elastic_limit_spread=0.0))]

    def limits(table):
        return np.concatenate([table["limit"][:, :, :], table["limit_slope"][:, :, :]])

    few, many = (lane_table(people(parts), [Environment()] * 3, 2.5e-3) for parts in (8, 24))
    tables = list(divisions(few, [person.muscle for person in people(8)], 3, range(3)))
    together = np.sort(np.concatenate([limits(table) for table in tables], axis=2), axis=2)
    np.testing.assert_allclose(together, np.sort(limits(many), axis=2), rtol=1e-12)
    (alone,) = divisions(few, [person.muscle for person in people(8)], 1, [0])
    np.testing.assert_allclose(limits(alone), limits(few), rtol=1e-12)
    # Limits differ, nothing else does.
    others = [name for name in few.dtype.names if not name.startswith("limit")]
    assert all((table[others] == few[others]).all() for table in tables)
    linear = lane_table([replace(PERSON, muscle=None)], [Environment()], 2.5e-3)
    assert all((table == linear).all() for table in divisions(linear, [None], 2, range(2)))
