"""The driver for controllers that speak the binary link of docs/wire-tcp.md."""
