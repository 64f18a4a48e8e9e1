declare module "*.schema.json" {
  const schema: import("./core/schema").Schema;
  export default schema;
}
