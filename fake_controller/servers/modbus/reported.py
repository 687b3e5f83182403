"""What a controller reports of itself in registers; the map is in drivers/wire/modbus.py."""

from __future__ import annotations

from drivers.wire import modbus as wire
from drivers.wire.registers import Block
from fake_controller.controller import CONTROLLER, PERIOD, VERSION, Controller


def own_registers(controller: Controller, block: Block) -> list[int] | None:
    """The registers of identity, joint names, status, frames and alarms; None for any other block."""
    state, joints = controller.state, controller.robot.dof
    if block is wire.IDENTITY:
        return block.pack(
            magic=wire.MAGIC,
            version=wire.VERSION,
            joints=joints,
            period=round(PERIOD * 1e9),
            slots=wire.slot_count(joints),
            robot=controller.name,
            serial=controller.serial,
            controller=CONTROLLER,
            software=VERSION,
        )
    if block in wire.NAMES:
        first = wire.NAMES.index(block) * wire.NAMES_PER_BLOCK
        return block.pack(names=controller.robot.joint_names[first : first + wire.NAMES_PER_BLOCK])
    if block is wire.STATUS:
        flags = {
            wire.Flag.DRIVES_ON: state.drives_on,
            wire.Flag.EMERGENCY_STOP: state.emergency_stop,
            wire.Flag.CELL_CLOSED: state.cell_closed,
            wire.Flag.MOVING: controller.moving,
            wire.Flag.EMULATOR: state.emulator,
        }
        name, checksum = controller.stored
        return block.pack(
            flags=sum(flag for flag, on in flags.items() if on),
            mode=wire.MODES.get(state.mode, 0),
            alarms=len(state.alarms),
            override=state.override,
            position=controller.position,
            program=name,
            checksum=bytes.fromhex(checksum),
        )
    if block is wire.FRAMES:
        base, uframe, tool = controller.frames
        return block.pack(base=base, tool=tool, uframe=uframe)
    if block is wire.ALARMS:
        return block.pack(text="\n".join(state.alarms))
    return None
