"""What each command does, without click: inputs opened, stages called in order, outputs written."""
