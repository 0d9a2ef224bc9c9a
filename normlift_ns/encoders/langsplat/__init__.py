"""Import and export of regions and features in the format of LangSplat's preprocessing."""
