"""The driver for controllers with the register map of docs/wire-modbus.md."""
