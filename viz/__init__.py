"""What people look at: reads run folders only, and never the process that trains."""
