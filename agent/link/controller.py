"""Driver of the recipe's controller, with the robot data it needs."""

from __future__ import annotations

import json
from collections.abc import Callable, Iterator
from contextlib import contextmanager

from agent.recipe import Recipe
from drivers.protocol import Driver, Identity, MeasuresCurrents, RequiresOperator


def create_driver(recipe: Recipe, tell: Callable[[str], None]) -> Driver:
    """The driver that the recipe names, not connected yet; `tell` is for whoever stands at the controller.

    Raises:
        ConfigurationError: no such driver, or an address that it cannot use.
        InputError: it delivers motor currents, and the robot description has no torque constants.
    """
    from agent.robot import torque_per_ampere
    from drivers.registry import create

    driver = create(recipe.controller.driver, recipe.controller.address, **recipe.controller.options)
    if isinstance(driver, MeasuresCurrents):
        driver.torque_per_ampere = torque_per_ampere(recipe.robot)
    if isinstance(driver, RequiresOperator):
        driver.tell = tell
    return driver


@contextmanager
def answering(recipe: Recipe) -> Iterator[tuple[Driver, Identity]]:
    """Connect to the recipe's controller for queries only; yields driver and identity.

    Raises:
        ControllerError: another robot.
        ConfigurationError, InputError: as in `create_driver`.
        DriverError: nobody there, silent, or another protocol.
    """
    from agent.safety import check_identity

    driver = create_driver(recipe, lambda _: None)
    try:
        driver.connect()
        identity = driver.identify()
        check_identity(identity, recipe.robot, recipe.controller.public_address)
        yield driver, identity
    finally:
        driver.close()


def torque_facts(recipe: Recipe, driver: Driver) -> dict[str, str]:
    """Facts for the log on how torque was obtained; empty if the controller delivers torque."""
    if not isinstance(driver, MeasuresCurrents):
        return {}
    constants = {joint.name: joint.torque_constant for joint in recipe.robot.joints}
    return {
        "torque_source": "motor current x torque constant x gear ratio, through the motor coupling",
        "torque_constants_nm_per_a": json.dumps(constants),
    }
