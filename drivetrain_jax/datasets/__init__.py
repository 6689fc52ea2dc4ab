"""Results and atlases as xarray sees them: the backend that opens an atlas as a lazy Dataset, the accessor, the figures."""
