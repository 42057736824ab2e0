"""Haptic devices with force output: protocol, device servers, the reflection beside a machine."""
