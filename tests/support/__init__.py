"""What several tests share: scenes, rigs, fake devices, graphs."""
