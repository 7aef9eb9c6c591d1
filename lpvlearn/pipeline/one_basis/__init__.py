"""All local models in one basis: step 4, or what takes its place."""
