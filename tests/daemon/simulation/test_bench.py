import numpy as np
import pytest

from triaxcald.simulation.bench import CHECK_POSES, CHECK_TOURS, CheckedTumble, DeviceFile, physics_of, tumble_of


def device(**fixture: float) -> DeviceFile:
    described = {
        "format": "triaxcal.device/1",
        "profile": "triax-ref-modbus",
        "bus": {"transport": "tcp", "host": "127.0.0.1", "port": 1502, "unit_id": 1},
        "fixture": {"poses": 9, "attitude_error_deg": 0.0, **fixture},
    }
    return DeviceFile.model_validate(described)


def held(tumble: CheckedTumble, steps: range) -> np.ndarray:
    """The specific force in the middle of each hold."""
    return tumble.specific_force(np.array(steps) * tumble.step_s + tumble.hold_s / 2)


def test_the_fixture_goes_through_the_plan_and_the_first_pose_once_more_again_and_again() -> None:
    tumble = tumble_of(device())
    poses = held(tumble, range(20))
    assert len(np.unique(poses[:9].round(6), axis=0)) == 9
    np.testing.assert_allclose(poses[9], poses[0], atol=1e-12)
    np.testing.assert_allclose(poses[10:], poses[:10], atol=1e-12)


def test_a_restart_sends_it_through_other_attitudes_once() -> None:
    tumble = tumble_of(device())
    never = held(tumble, range(40))
    tumble.restarted(7 * tumble.step_s + 1.0)
    poses = held(tumble, range(40))
    np.testing.assert_array_equal(poses[:8], never[:8])
    np.testing.assert_allclose(poses[8 : 8 + CHECK_POSES], tumble.tours[0], atol=1e-12)
    np.testing.assert_array_equal(poses[8 + CHECK_POSES :], never[8 + CHECK_POSES :])


def test_the_pose_during_a_restart_is_held_to_its_end() -> None:
    tumble = tumble_of(device())
    t_s = np.linspace(0.0, tumble.hold_s, 50)
    before = tumble.specific_force(t_s)
    tumble.restarted(tumble.hold_s / 2)
    np.testing.assert_array_equal(tumble.specific_force(t_s), before)


@pytest.mark.parametrize("restart", range(1, 2 * CHECK_TOURS))
def test_each_restart_has_a_tour_of_its_own_until_all_have_been_gone(restart: int) -> None:
    tumble = tumble_of(device())
    for i in range(restart + 1):
        tumble.restarted(100.0 * i)
    first = int(100.0 * restart // tumble.step_s) + 1
    tour = held(tumble, range(first, first + CHECK_POSES))
    np.testing.assert_allclose(tour, tumble.tours[restart % CHECK_TOURS], atol=1e-12)


@pytest.mark.parametrize("poses", [9, 14, 26])
def test_no_tour_repeats_an_attitude_of_the_plan_or_of_another_tour(poses: int) -> None:
    tumble = tumble_of(device(poses=poses))
    assert tumble.tours.shape == (CHECK_TOURS, CHECK_POSES, 3)
    every = np.concatenate([tumble.directions[:-1], tumble.tours.reshape(-1, 3)])
    cosines = np.clip(every @ every.T, -1.0, 1.0) - 2 * np.eye(len(every))
    # the directions with up to two parts of each axis lie at least arccos(5/sqrt(27)), 15.8 degrees, apart
    assert np.degrees(np.arccos(cosines.max())) > 15.7


def test_every_attitude_is_off_by_the_attitude_error_of_the_fixture() -> None:
    exact, off = tumble_of(device()), tumble_of(device(attitude_error_deg=2.0))
    cosines = np.sum(exact.tours * off.tours, axis=2)
    angles = np.degrees(np.arccos(np.clip(cosines, -1.0, 1.0)))
    # two components across the direction, each normal with 2 degrees: a Rayleigh distribution
    assert np.sqrt(np.mean(angles**2)) == pytest.approx(2.0 * np.sqrt(2), rel=0.3)
    np.testing.assert_allclose(np.linalg.norm(off.tours, axis=2), 1.0, atol=1e-12)


def test_a_restart_of_the_unit_reaches_the_fixture() -> None:
    physics = physics_of(device())
    physics.restarted(0.0)
    middle = physics.fixture.step_s + physics.fixture.hold_s / 2
    output, _ = physics.sample(np.array([middle]))
    other, _ = physics_of(device()).sample(np.array([middle]))
    assert np.linalg.norm(output - other) > 0.1
