"""What a person drives with: keyboard, gamepad, SpaceMouse, or a script in their place."""
