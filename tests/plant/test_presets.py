from __future__ import annotations

from plant import paper_link


def test_the_paper_link_has_the_papers_link():
    rig = paper_link()
    assert (rig.link.length_m, rig.link.width_m, rig.link.thickness_m) == (1.0, 0.00635, 0.00635)
    assert rig.sampling.dt_s == 1 / 200
