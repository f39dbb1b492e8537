"""What a person does: report, export, calibrate, identify, look at pictures. Never on board."""
