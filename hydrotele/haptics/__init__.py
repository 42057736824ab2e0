"""Haptic devices with force output: protocol, device drivers, servers and force reflection."""
