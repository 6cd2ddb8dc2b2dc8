"""Shots that another recorder wrote, fitted by renders; tests/foreign_shots.py has more of them and more passes."""

from functools import partial

import foreign_shots
import numpy as np
import pytest

import mitransient_lidar
from mitransient_lidar.studies import fit as study


@pytest.mark.long
@pytest.mark.parametrize("instrument", ["riegl_vq840g", "leica_chiroptera4x", "leica_hawkeye4x_deep"])
def test_a_foreign_shot_is_found_within_its_errors(instrument, tmp_path, monkeypatch):
    """Scaled, shifted by up to 1300 ns, noise unknown; attenuation and reflectance 25 to 50 % off, depth up to 25 %."""
    monkeypatch.setattr(study, "render", partial(mitransient_lidar.render, pass_share=1 / 16))
    foreign_shots.shot_of(instrument, tmp_path, passes=16, pass_share=1 / 4)
    fitted, z, _ = foreign_shots.fit_foreign(instrument, 1, tmp_path, passes=4)
    assert fitted.attrs["converged"]
    # The shot behind the record has few passes: its own error adds to the stated ones.
    assert np.abs(z).max() < 6, z
