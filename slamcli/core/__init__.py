"""The words every floor speaks: errors, geometry, records and configuration."""
